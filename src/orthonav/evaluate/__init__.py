"""How good the fixes of a flight are: figures, pictures and a report, given the truth.

`metrics` computes and knows nothing of files or plots; `plots` draws what it computed; `report`
writes both into one page.
"""
