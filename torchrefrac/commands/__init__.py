"""The commands: read, compute, evaluate, write; one module each, beside the folder that they write."""
