"""The experiments of Di Piazza et al., IGARSS 2024, run with orthonav's own code.

`methods` is the paper's Table 1 and its section Methodology, `scenes` its section Dataset, `runs`
one method on one trajectory, `tables` its Tables 2 and 3. `curves`, `dates`, `field` and `words`
are further experiments with their tables; `page` shows all tables. `docs/paper.md` says what came
out.
"""
