"""Every format that goes in or comes out; no format is known anywhere else."""
