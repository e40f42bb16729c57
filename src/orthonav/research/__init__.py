"""The methods of Di Piazza et al. 2024, one module a method; `docs/paper.md` maps its sections.

Encoders and words are learned here before the flight, with PyTorch or faiss; `orthonav.core.tiles`
runs them on board. Of this package, only `segments` and `caevl_recipe` are used in flight.
"""
