"""The experiments of Di Piazza et al., IGARSS 2024, run with orthonav's own code.

`trajectories` is the paper's Table 1, `views` its section Dataset, `methods` its section
Methodology, `runs` what is done with one method on one trajectory, `tables` its Tables 2
and 3. `docs/paper.md` says what came out.
"""
