"""Representations: what of a picture is compared, grey levels or edges or gradients.

Every variant is called as `variant(grey, valid)` with `grey` (H, W) uint8 and `valid` (H, W) bool
and gives float32 `(C, H, W)`, zero where not valid, without touching its inputs.
"""

from orthonav.variants import Variant

TABLE = {
    "gradient": Variant("orthonav.represent.gradients:OrientedGradients"),
    "gray": Variant("orthonav.represent.gray:Gray"),
    "canny": Variant("orthonav.represent.canny:Canny"),
    "segments": Variant("orthonav.represent.segments:Segments", extra="segments"),
    "sam": Variant("orthonav.neural.sam:SamBoundaries", flies=False, extra="train"),
}
