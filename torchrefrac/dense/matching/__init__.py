"""Interest points, and where another image may show the same along a ray's curved image."""
