"""The matches of a view in a whole atlas, each against the best other one.

Searching a region takes ten times as long as judging the place near its middle. So all candidates
are judged, those with hope are finished, and of these the strongest are searched until one is
proven. The others count as rivals by what is known of them, as the candidates of one search do
within a sheet (`orthonav.core.localize.place`).
"""

import math
from collections.abc import Mapping, Sequence

from orthonav.core.localize.confidence import USUAL_CONFIDENCE, logit
from orthonav.core.localize.place import HOPE, MIN_HOPEFUL
from orthonav.core.localize.policy import DEFAULT_PLAN
from orthonav.ground.atlas.agreement import nearest_m
from orthonav.ground.atlas.sheet_registration import (
    JudgedRegion,
    SearchRegion,
    SheetMatch,
    ViewRegistrar,
)

SEARCHED = 4
"""At most so many candidates are searched: the right one and the best rivals are among them
(docs/decisions/atlas.md)."""
PROVEN = logit(1 - DEFAULT_PLAN.policy.trial_doubt, 0.0)
"""Log odds of a match that ends the search of candidates: as for a place whose rivals were not all
searched."""
RIVAL_SHARE = 0.25
"""Matches farther apart than this share of the view's side are different places."""
LEAST = 1e-5
"""Least and greatest (1 - LEAST) probability of a match, for finite odds."""


class ViewMatches:
    """The matches of a view `side_m` wide.

    `found`: the strongest of each place, strongest first. `compared`: the regions of candidates
    that were finished, or searched.
    """

    def __init__(self, side_m: float) -> None:
        self._apart_m = RIVAL_SHARE * side_m
        self._judged: list[JudgedRegion] = []
        self.compared: list[SearchRegion] = []
        self.found: list[SheetMatch] = []

    def add_candidates(self, registrar: ViewRegistrar, regions: Sequence[SearchRegion]) -> None:
        """Judge candidates, finish those with hope, search the strongest until one is proven."""
        judged = [each for each in map(registrar.judged, regions) if each is not None]
        judged.sort(key=lambda each: -each.look)
        hopeful = sum(each.look >= HOPE * judged[0].look for each in judged)
        hopeful = max(hopeful, MIN_HOPEFUL)
        self._judged = judged[hopeful:]
        self.compared = [each.region for each in judged[:hopeful]]
        finished = [(each.finished(), each) for each in judged[:hopeful]]
        finished.sort(key=lambda each: -each[0].evidence["strength"])
        found = [match for match, _ in finished]
        self.found = self._distinct(found)
        searched: list[SheetMatch] = []
        for number, (_, region) in enumerate(finished[:SEARCHED]):
            match = region.searched()
            if match is None:
                continue
            searched.append(match)
            if nearest_m(match.latlon_deg, [found[number].latlon_deg]) > self._apart_m:
                found.append(match)  # the place that was judged remains a rival
            else:
                found[number] = match
            self.found = self._distinct(found)
            if self._proven and self.found[0] in searched:
                break

    def add_expected(self, registrar: ViewRegistrar, regions: Sequence[SearchRegion]) -> None:
        """Search the regions where a view is expected, the likeliest first, up to one in which the
        strongest match is proven. One in which a candidate is proven already is not searched."""
        for region in regions:
            if not self._proven_in(region) and (found := registrar.searched(region)):
                self.found = self._distinct([*self.found, found])
            if self._proven_in(region):
                break

    @property
    def _proven(self) -> bool:
        """Whether the strongest match is proven."""
        return bool(self.found) and self.log_odds(0) >= PROVEN

    def _proven_in(self, region: SearchRegion) -> bool:
        """Whether it is, and lies in a region."""
        return self._proven and region.contains(self.found[0])

    def log_odds(self, number: int) -> float:
        """Log odds of one of the matches against all others."""
        one = self.found[number]
        rivals = [each.evidence for at, each in enumerate(self.found) if at != number]
        looks = [
            each.look
            for each in self._judged
            if nearest_m(each.latlon_deg, [one.latlon_deg]) > self._apart_m
        ]
        confidence = one.confidence or USUAL_CONFIDENCE
        return logit(confidence(against(one.evidence, rivals, looks)), LEAST)

    def _distinct(self, matches: Sequence[SheetMatch]) -> list[SheetMatch]:
        """The strongest match of each place, strongest first."""
        distinct: list[SheetMatch] = []
        for each in sorted(matches, key=lambda one: -one.evidence["strength"]):
            others = [one.latlon_deg for one in distinct]
            if nearest_m(each.latlon_deg, others) > self._apart_m:
                distinct.append(each)
        return distinct


def against(
    evidence: Mapping[str, float],
    rivals: Sequence[Mapping[str, float]],
    looks: Sequence[float] = (),
) -> dict[str, float]:
    """The evidence of a match with the best other match of the whole atlas as its rival.

    `looks`: scores, at the level where views are judged, of places that were not finished. The
    finest level counts only where the strongest rival was compared there too.
    """
    made = dict(evidence)
    for rival, value in (("rival", "strength"), ("look_rival", "look")):
        made[rival] = max([made[rival], *(each[value] for each in rivals)])
    made["look_rival"] = max([made["look_rival"], *looks])
    strongest = max(rivals, key=lambda each: each["strength"], default=None)
    if strongest is None or not math.isfinite(made["fine"]):
        return made
    if math.isfinite(strongest["fine"]):
        made["fine_rival"] = max(made["fine_rival"], strongest["fine"])
    else:
        made["fine"] = made["fine_rival"] = math.nan
    return made
