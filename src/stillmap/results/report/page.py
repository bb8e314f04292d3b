"""`report.html`: one self-contained page about a run, rendered from the Jinja2 templates beside."""

import base64
import functools
import hashlib
import os
import sys
from collections.abc import Mapping
from importlib.util import cache_from_source
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stillmap.core.config import iter_options
from stillmap.core.files import package_version
from stillmap.pipeline.result import MappingResult
from stillmap.results.report.estimation import calibration_data, convergence_data, fitted_data
from stillmap.results.report.facts import (
    files_data,
    quality_data,
    run_data,
    source_data,
    stages_data,
)
from stillmap.results.report.formatting import FILTERS
from stillmap.results.report.maps import (
    changes_data,
    draw_filtered_map,
    evolution_data,
    map_data,
)
from stillmap.results.report.objects import objects_data, rig_data

if TYPE_CHECKING:
    from jinja2 import BytecodeCache, Environment

    from stillmap.mesh.build import Models
    from stillmap.rig.build import TiltingResult

_TEMPLATES = Path(__file__).parent / "templates"


def render_report(
    result: MappingResult,
    tilting: "TiltingResult | None" = None,
    models: "Models | None" = None,
    folder: Path | None = None,
) -> str:
    """The page, of a few megabytes at most: no outside request, images and script inline.

    Args:
        result: the mapped recording.
        tilting: 3D data of a rig's second laser.
        models: of the place and of moving objects.
        folder: the result folder, to whose files the page links; None: no links.
    """
    filtered = draw_filtered_map(result)
    data = {
        "run": run_data(result),
        "maps": map_data(result, filtered),
        "quality": quality_data(result),
        "files": files_data(folder),
        "changes": changes_data(result, filtered),
        "objects": objects_data(result, filtered),
        "points": _points_data(result, tilting),
        "rig": rig_data(tilting, filtered),
        "models": None if models is None else _models_data(models),
        "fitted": fitted_data(result),
        "calibration": calibration_data(result),
        "convergence": convergence_data(result),
        "evolution": evolution_data(result),
        "source": source_data(result),
        "stages": stages_data(result),
        "options": [(one.name, one.value) for one in iter_options(result.options)],
    }
    return render_page("report.html.j2", data)


def render_page(template: str, data: Mapping[str, Any]) -> str:
    """A page from one of the templates."""
    found = environment().get_template(template)
    return found.render({**data, "version": package_version(), **script_data()})


def _points_data(result: MappingResult, tilting: "TiltingResult | None") -> dict[str, Any] | None:
    """See `point_view.points_data`, whose renderer is loaded only for results in 3D."""
    if tilting is None and result.recording.dimension == 2:
        return None
    from stillmap.results.report.point_view import points_data

    return points_data(result, tilting)


def _models_data(models: "Models") -> dict[str, Any]:
    """The record of the models, and why no image could texture anything; see `models_record`."""
    from stillmap.results.models import models_record  # meshes take long to load

    record = models_record(models)
    pictures = record["pictures"]
    reasons = {**pictures["left_out"], "damaged": len(pictures["unread"])}
    listed = "; ".join(f"{count:,}: {why}" for why, count in reasons.items() if count)
    return {**record, "untextured_reason": "" if record["area_painted"] else listed}


@functools.cache
def script_data() -> dict[str, str]:
    """The page's script, and its hash, without which browsers run no script of the page."""
    script = (_TEMPLATES / "map_view.js").read_text(encoding="utf-8")
    digest = hashlib.sha256(script.encode()).digest()
    return {"script": script, "script_hash": base64.b64encode(digest).decode("ascii")}


@functools.cache
def environment() -> "Environment":
    """The templates with the filters of `formatting`; HTML in data is escaped."""
    # jinja2 is loaded only where a report is written
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    found = Environment(
        bytecode_cache=_bytecode_cache(),
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    found.filters.update(FILTERS)
    return found


def _bytecode_cache() -> "BytecodeCache | None":
    """Compiled templates, kept where Python keeps its modules; None: Python keeps none either.

    Compiling takes longer than rendering.
    """
    if sys.dont_write_bytecode:
        return None
    from jinja2 import FileSystemBytecodeCache

    folder = Path(cache_from_source(str(_TEMPLATES / "report.py"))).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return FileSystemBytecodeCache(str(folder)) if os.access(folder, os.W_OK) else None
