"""What a check leaves behind: a page, JSON, a raster, shapes for a map viewer, figures, text.

`write_check` writes the folder, `require_free` says before the work is done whether it can;
`verdict_text` makes what a terminal shows.
"""

from orthonav.check.write.folder import require_free, write_check
from orthonav.check.write.plain import to_json
from orthonav.check.write.text import text as verdict_text

__all__ = ["require_free", "to_json", "verdict_text", "write_check"]
