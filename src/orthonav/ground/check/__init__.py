"""Pre-flight check: where on a map can views be placed, and can a route be flown with it?"""
