"""How torchrefrac runs several jobs: a sweeper and launchers for Hydra."""
