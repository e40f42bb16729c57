"""Map building on the workstation: from orthophotos to the map that flies."""

from orthonav.ground.build.build import BuildRequest, BuildResult, build_map

__all__ = ["BuildRequest", "BuildResult", "build_map"]
