"""The command line: Hydra composes the options, this package hands them to the pipeline. Nothing else imports Hydra."""
