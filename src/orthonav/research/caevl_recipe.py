"""Parameters of CAEVL, the successor of the auto-encoder; it flies as any neural encoder does.

Amadei, Meinhardt-Llopis, Bascle, Abgrall and Facciolo, "Beyond Paired Data: Self-Supervised UAV
Geo-Localization from Reference Imagery Alone", WACV 2026 (arXiv 2512.02737).
"""

from dataclasses import dataclass, fields, replace

from orthonav.core.tiles.network import AutoEncoderRecipe
from orthonav.core.variants import choice, within


@dataclass(frozen=True)
class CaevlRecipe(AutoEncoderRecipe):
    """Parameters of CAEVL: an auto-encoder, then its encoder fine-tuned with VICReg.

    Defaults are those of the authors' released configuration; other fields are those of
    `AutoEncoderRecipe`. Its `epochs` and `learning_rate` are those of the auto-encoder.
    """

    batch: int = within(128, 2, 65_536)  # of both trainings
    learning_rate: float = within(6e-5, 0, 1, above=True)
    similarity: str = choice("cosine", "product")
    tuning_epochs: int = within(100, 1, 100_000)
    tuning_rate: float = within(6e-5, 0, 1, above=True)
    projector: int = within(4096, 1, 16_384)  # numbers per layer of the global projection head
    alpha: float = within(0.75, 0, 1)  # weight of the global loss; the rest is the local one's

    def first(self) -> AutoEncoderRecipe:
        return AutoEncoderRecipe(
            **{each.name: getattr(self, each.name) for each in fields(AutoEncoderRecipe)}
        )

    def exchanged(self) -> "CaevlRecipe":
        """The same with the two trainings exchanged: its `epochs` are those of the fine-tuning.

        The engine that trains reads `epochs` and `learning_rate`, and a checkpoint of the
        fine-tuning still depends on every parameter of the auto-encoder.
        """
        return replace(
            self,
            epochs=self.tuning_epochs,
            learning_rate=self.tuning_rate,
            tuning_epochs=self.epochs,
            tuning_rate=self.learning_rate,
        )
