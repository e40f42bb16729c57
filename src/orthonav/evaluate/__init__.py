"""How good the fixes of a flight are: figures, pictures and a report, given the truth.

`metrics` computes and knows nothing of files or plots, `calibration` is its part on what fixes say
about themselves; `plots` and `calibration_plots` draw what they computed; `report` writes it all
into one page.
"""
