"""Many runs: which they are, how they ended, and what they say together; each module is imported by itself."""
