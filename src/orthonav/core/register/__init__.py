"""Registration: a view laid on the map, to fractions of a pixel, or refused.

`channels` is what is compared (oriented gradients and locally normalized grey), `template` a view
made ready at several resolutions, `window` the map made ready where it is looked at, `search`
finds candidates by FFT over a bank of headings and scales, `refine` moves each candidate to its
best position, heading and scale and says how well it fits and how exactly it is known."""
