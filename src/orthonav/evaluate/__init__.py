"""How good the fixes of a flight are: figures, pictures and a report, given the truth.

`metrics` computes and knows nothing of files or plots, `calibration` is its part on what fixes say
about themselves, `track` on tracks; the modules named `plots` draw what they computed; `flights`
tells it as tables and JSON values, `report` as one page in the look of `orthonav.report`.
"""
