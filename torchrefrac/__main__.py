"""`python -m torchrefrac`."""

from torchrefrac.cli import main

main()
