"""`--report-changes` of localize and evaluate: ground that no longer looks like the map."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from orthonav.core.errors import MapFileError

if TYPE_CHECKING:
    from orthonav.cli.common import Progress
    from orthonav.core.flight.recording import Flight
    from orthonav.core.localize.localizer import RegistrationLocalizer
    from orthonav.core.mapfile.reader import MapFile
    from orthonav.core.records import ViewResult
    from orthonav.ground.changes.record import ChangedGround


def add_report_changes(parser: argparse._ActionsContainer) -> None:
    parser.add_argument(
        "--report-changes",
        type=Path,
        metavar="FILE.geojson",
        help="write where the ground no longer looks like the map, by the confident views; "
        "`check --changes` reads it",
    )


def check_comparable(
    options: argparse.Namespace, found: "RegistrationLocalizer | None", opened: "MapFile"
) -> None:
    if options.report_changes and found is None:
        raise MapFileError(
            "--report-changes needs a map with a registration layer, and not --registration off: "
            f"{opened.path}"
        )


def report_changes(
    options: argparse.Namespace,
    opened: "MapFile",
    flights: "Sequence[tuple[Flight, Sequence[ViewResult]]]",
    shown: "Progress",
) -> "ChangedGround | None":
    """Compare the confident views of flights with the map and write what was asked for.

    None, and nothing is written, where it was not asked for or no view is confident. Raises
    `MapFileError` for a map without a registration layer.
    """
    from orthonav.core.localize import Localizer
    from orthonav.core.mapfile.signature import map_digest
    from orthonav.ground.changes.ground import cell_side_m, changed_ground, views_beside_map
    from orthonav.ground.changes.record import ChangeGrid, write_changes

    if options.report_changes is None:
        return None
    registration = Localizer(opened, level_ground=True).registration
    check_comparable(options, registration, opened)
    assert registration is not None
    side_m = cell_side_m([(flight.camera, results) for flight, results in flights])
    if side_m is None:
        return None
    grid = ChangeGrid.of_sheet(registration.sheet, side_m)
    views = [
        view
        for flight, results in flights
        for view in views_beside_map(
            registration, grid, flight, results, lambda share: shown("changes", share)
        )
    ]
    found = changed_ground(
        views, grid, map_name=opened.path.name, map_sha256=map_digest(opened.path)
    )
    write_changes(options.report_changes, found)
    return found


def changes_text(options: argparse.Namespace, found: "ChangedGround | None") -> list[str]:
    if options.report_changes is None:
        return []
    if found is None:
        return ["changes: no view is confident; nothing was written"]
    return [f"changes: {found.text()}; written to {options.report_changes}"]


def changes_to_plain(
    options: argparse.Namespace, found: "ChangedGround | None"
) -> dict[str, object]:
    if options.report_changes is None:
        return {}
    if found is None:
        return {"changes": None}
    areas = {"seen_m2": round(found.seen_m2), "changed_m2": round(found.changed_m2)}
    return {"changes": {"file": str(options.report_changes), **areas}}
