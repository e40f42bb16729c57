"""Writes a check: a page, JSON, a GeoTIFF, GeoJSON and figures; and as text for a terminal."""

from orthonav.ground.check.write.folder import require_free, write_check
from orthonav.ground.check.write.plain import to_json
from orthonav.ground.check.write.wording import text as verdict_text

__all__ = ["require_free", "to_json", "verdict_text", "write_check"]
