"""GNSS monitor: positions of GNSS are compared with those of the map, and never used as ours.

`biases` holds the faults and the difference GNSS minus map: what is constant in
it, how that is learnt, and the tests of a change; `monitor` checks a receiver by itself and against
the map, `watch` connects the monitors to a flight. Figures and choices: docs/gnss.md.
"""
