"""A witness for GNSS: its positions are compared with those of the map, and never used as ours.

`records` holds what goes in and out, `receiver` checks a receiver by itself, `difference` compares
it with the map over a window, `displacement` learns the constant displacement of the map, `monitor`
joins them into a state, `watch` connects the monitor to a flight. Figures and choices:
docs/decisions/gnss.md.
"""
