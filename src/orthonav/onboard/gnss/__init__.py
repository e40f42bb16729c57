"""GNSS monitor: positions of GNSS are compared with those of the map, and never used as ours.

`records` holds what goes in and out, `receiver` checks a receiver by itself, `difference` compares
it with the map over a window, `biases` and `learner` hold and learn what is constant in the
difference (displacement of the map, mount, latency), `rolling` widens it while the aircraft rolls,
`monitor` joins them into a state, `watch` connects the monitor to a flight. Figures and choices:
docs/decisions/gnss.md.
"""
