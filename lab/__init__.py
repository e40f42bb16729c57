"""Tools of the checkout that are not installed: generated imagery for tests and benchmarks."""
