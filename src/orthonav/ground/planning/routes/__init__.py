"""Reading and writing routes: one module per file format, all giving `Route`."""
