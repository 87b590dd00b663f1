"""The tests, and what they share; imported before the package, whose signatures are checked in all of them."""

from tests.typechecking import install

install()
