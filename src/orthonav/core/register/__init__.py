"""Registration: a view laid on the map, to fractions of a pixel, or refused.

`template` is a view made ready at several resolutions, by channels of oriented gradients and
locally normalized grey; `window` the map made ready where it is looked at, under a pose; `search`
finds candidates by FFT over a bank of headings and scales; `refine` moves each candidate to its
best position, heading and scale and says how well it fits, how exactly it is known, how far it
stands out from the ground around it, and how its blocks fit a little aside."""
