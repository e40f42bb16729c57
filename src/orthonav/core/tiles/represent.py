"""Image representations that are compared: grey levels, edges or gradients.

Every variant is called as `variant(grey, valid)` with `grey` (H, W) uint8 and `valid` (H, W) bool
and returns float32 `(C, H, W)`, zero where not valid; its inputs stay unchanged.
"""

from orthonav.core.variants import Variant

TABLE = {
    "gradient": Variant("orthonav.core.tiles.gradients:OrientedGradients"),
    "gray": Variant("orthonav.core.tiles.gray:Gray"),
    "canny": Variant("orthonav.core.tiles.canny:Canny"),
    "segments": Variant("orthonav.research.segments:Segments", extra="segments"),
    "onnx": Variant("orthonav.core.tiles.learned:LearnedEdges", extra="neural"),
    "sam": Variant("orthonav.research.sam:SamBoundaries", flies=False, extra="train"),
}
