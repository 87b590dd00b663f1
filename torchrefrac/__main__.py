"""`python -m torchrefrac`."""

from torchrefrac.launch import main

main()
