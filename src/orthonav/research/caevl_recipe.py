"""Parameters of CAEVL, the successor of the auto-encoder; it flies as any neural encoder does.

Amadei, Meinhardt-Llopis, Bascle, Abgrall and Facciolo, "Beyond Paired Data: Self-Supervised UAV
Geo-Localization from Reference Imagery Alone", WACV 2026 (arXiv 2512.02737).
"""

from dataclasses import dataclass, fields, replace

from orthonav.core.errors import VariantError
from orthonav.core.tiles.network import AutoEncoderRecipe


@dataclass(frozen=True)
class CaevlRecipe(AutoEncoderRecipe):
    """Parameters of CAEVL: an auto-encoder, then its encoder fine-tuned with VICReg.

    Defaults are those of the authors' released configuration. `epochs`, `learning_rate`: of the
    auto-encoder. `tuning_epochs`, `tuning_rate`: of the fine-tuning. `batch`: of both.
    `projector`: numbers per layer of the global projection head. `alpha`: weight of the global
    loss, the rest is that of the local one, 0 to 1. The others are as in `AutoEncoderRecipe`.
    """

    batch: int = 128
    learning_rate: float = 6e-5
    similarity: str = "cosine"
    tuning_epochs: int = 100
    tuning_rate: float = 6e-5
    projector: int = 4096
    alpha: float = 0.75

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (1 <= self.tuning_epochs <= 100_000 and 0 < self.tuning_rate <= 1):
            raise VariantError(
                "tuning_epochs must be 1 to 100000 and tuning_rate above 0, at most 1, got "
                f"{self.tuning_epochs} and {self.tuning_rate}"
            )
        if not 1 <= self.projector <= 16_384:
            raise VariantError(f"projector must be 1 to 16384, got {self.projector}")
        if not 0 <= self.alpha <= 1:
            raise VariantError(f"alpha must be 0 to 1, got {self.alpha}")
        if self.batch < 2:
            raise VariantError(f"batch must be at least 2, got {self.batch}")

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
