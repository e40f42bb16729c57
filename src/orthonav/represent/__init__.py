"""Image representations that are compared: grey levels, edges or gradients.

Every variant is called as `variant(grey, valid)` with `grey` (H, W) uint8 and `valid` (H, W) bool
and returns float32 `(C, H, W)`, zero where not valid; its inputs stay unchanged.
"""

from orthonav.variants import Variant

TABLE = {
    "gradient": Variant("orthonav.represent.gradients:OrientedGradients"),
    "gray": Variant("orthonav.represent.gray:Gray"),
    "canny": Variant("orthonav.represent.canny:Canny"),
    "segments": Variant("orthonav.represent.segments:Segments", extra="segments"),
    "onnx": Variant("orthonav.represent.learned:LearnedEdges", extra="neural"),
    "sam": Variant("orthonav.neural.sam:SamBoundaries", flies=False, extra="train"),
}
