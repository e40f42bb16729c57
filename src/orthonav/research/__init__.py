"""Neural networks: learning them from reference tiles and turning them into what flies.

Nothing here flies. Learning needs PyTorch, writing what flies needs ONNX and onnxruntime; on
board, `orthonav.core.tiles.network` needs onnxruntime alone.
"""
