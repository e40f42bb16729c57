"""Before the flight: where could views be placed on a map, and would a route be flown well?"""
