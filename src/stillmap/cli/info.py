"""`stillmap info INPUT...`: print summaries of recordings."""

import argparse
import json
import math
from collections.abc import Iterator
from typing import Any

from stillmap.cli.arguments import add_option_flags, add_read_flags, read_options
from stillmap.cli.console import print_lines, show_share

_LINES_SHOWN = 10
DESCRIPTION = (
    "Show what is in a recording: scans, beams, field of view, ranges, duration, "
    "odometry and damage; values estimated from the readings are marked."
)
EPILOG = """examples:
  stillmap info log.clf.gz
  stillmap info sim --json
  stillmap info run_0.bag run_1.bag
  stillmap info log.log --max-range 30 --laser-offset 0.2 0 0

formats:
  CARMEN log          .log .clf .txt, plain or .gz
  ROS bag             .bag .db3 .mcap, a folder of ROS 2
  recording folder    with recording.json, of stillmap
  KITTI folder        with velodyne/ or velodyne_points/
  RGB-D folder        7-Scenes, 3DMatch, TUM RGB-D
  PCD, PLY            a file, or a folder of them
  LAS, E57, 3DTK      likewise
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the flags and arguments."""
    parser.add_argument(
        "input", metavar="INPUT", nargs="+", help="a file or folder with a recording"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    add_read_flags(parser)
    add_option_flags(parser)


def run(args: argparse.Namespace) -> int:
    """Print the summary.

    Raises:
        InputError: the recording cannot be read.
    """
    summaries = [_summarize(path, args) for path in args.input]
    if args.json:
        content = summaries[0] if len(summaries) == 1 else {"recordings": summaries}
        print(json.dumps(content, indent=2, allow_nan=False))
        return 0
    for number, summary in enumerate(summaries):
        print_lines([*([""] * (number > 0)), *_format_summary(summary)])
    return 0


def _summarize(path: str, args: argparse.Namespace) -> dict[str, Any]:
    from stillmap.cli.recording_info import summarize_recording
    from stillmap.io import read

    with show_share(args.quiet, "reading") as progress:
        recording = read(path, read_options(args), progress=progress)
    return {"input": path, **summarize_recording(recording)}


def _format_summary(info: dict[str, Any]) -> Iterator[str]:
    yield f"{info['input']}: {info['format'] or 'stillmap recording'}, {info['dimension']}D"
    if info["path"] not in (None, info["input"]):
        yield _row("made from", str(info["path"]))
    if info["beams_per_scan"] is None:
        yield _row("scans", "none")
        return
    yield from _format_beams(info)
    time = info["time"]
    rate = f", {time['rate_hz']:.2f} scans/s" if time["rate_hz"] else ""
    gap = f", largest gap {time['largest_gap_s']:.2f} s" if time["largest_gap_s"] else ""
    yield _row("duration", f"{time['duration_s']:.2f} s{rate}{gap}")
    yield _row("stamps", _format_stamps(time).removeprefix("stamps "))
    if part := info["part"]:
        seconds = (part["last_stamp_ns"] - part["first_stamp_ns"]) / 1e9
        left_out = f"{part['omitted']} scans left out"
        yield _row("part", f"of {seconds:.2f} s, {_format_stamps(part)}; {left_out}")
    yield from _format_poses(info)
    yield from _format_images(info["images"])
    if info["base_frame"] is not None:
        yield _row("robot's frame", f"{info['base_frame']} ({info['base_frame_how']})")
    for sensor in info["sensors"]:
        yield from _format_sensor(sensor)
    for box in info["self_filter"]:
        of = f" of sensor {box['sensor'] + 1}" if len(info["sensors"]) > 1 else ""
        spans = zip("xyz", box["low"], box["high"], strict=True)
        where = ", ".join(f"{axis} {low:g} to {high:g}" for axis, low, high in spans)
        text = f"{box['beams']} beams{of} end on it: unusable; {where} m from the sensor"
        yield _row("robot itself", text)
    yield from _format_notes(info)


def _format_stamps(span: dict[str, Any]) -> str:
    from stillmap.core.timestamps import format_seconds

    first, last = (format_seconds(span[key]) for key in ("first_stamp_ns", "last_stamp_ns"))
    return f"stamps {first} to {last}"


def _format_beams(info: dict[str, Any]) -> Iterator[str]:
    beams, shares = info["beams_per_scan"], info["counts"]["shares"]
    per_scan = f"{beams['median']:.0f}"
    if beams["min"] != beams["max"]:
        per_scan += f" ({beams['min']:.0f} to {beams['max']:.0f})"
    scans = f"{info['scans']} with {per_scan} beams each, {info['beams']} beams"
    yield _row("scans", f"1 with {info['beams']} beams" if info["scans"] == 1 else scans)
    words = (("hits", "hits"), ("max_range", "maximum range"), ("unusable", "unusable"))
    yield _row("beams", ", ".join(f"{100 * shares[key]:.2f} % {word}" for key, word in words))
    if info["hit_ranges_m"] is not None:
        form = "min {min:.2f}, median {median:.2f}, 99 % {p99:.2f}, max {max:.2f} m"
        yield _row("ranges of hits", form.format(**info["hit_ranges_m"]))
    if info["beam_times_s"] is not None:
        first, last = info["beam_times_s"]
        how = f", as it turns {info['spin']}" if info["spin"] else ""
        yield _row("beam times", f"{first:g} to {last:g} s after a scan's stamp{how}")
    elif info["dimension"] == 3 and info["scans"] > 1:
        yield _row("beam times", "none")


def _format_poses(info: dict[str, Any]) -> Iterator[str]:
    """Odometry and recorded poses."""
    from stillmap.core.timestamps import format_seconds

    form = "path {path_length_m:.2f} m, turned {turned_deg:.0f} deg"
    odometry, way = info["odometry"], info["recorded_poses"]
    if odometry is None:
        yield _row("odometry", "none")
    else:
        origin = f", from {odometry['from']}" if "from" in odometry else ""
        yield _row("odometry", form.format(**odometry) + origin)
        if (at := odometry["largest_step_at_ns"]) is not None:
            step = f"{odometry['largest_step_m']:.3f} m (after {format_seconds(at)})"
            yield _row("largest step", f"{step}, {odometry['largest_step_deg']:.1f} deg")
    if way is not None:
        yield _row("recorded poses", f"{form.format(**way)}: used with --poses recording")


def _format_images(images: dict[str, Any] | None) -> Iterator[str]:
    if images is None:
        return
    yield _row("images", f"{images['count']}, {images['usable']} of them usable")
    for camera in images["cameras"]:
        known = [word for word in ("calibrated", "placed") if camera[word]]
        size = f"{camera['count']} of {camera['width']} x {camera['height']} pixels"
        yield _row("  camera", f"{camera['name']}, {size}, {' and '.join(known) or 'uncalibrated'}")
    for reason, count in images["left_out"].items():
        yield _row("  left out", f"{count}: {reason}")


def _format_sensor(sensor: dict[str, Any]) -> Iterator[str]:
    frame = f", frame {sensor['frame']}" if sensor.get("frame") else ""
    yield _row("sensor", f"{sensor.get('name', 'unnamed')}, {sensor['scans']} scans{frame}")
    view, step = sensor.get("field_of_view_deg"), sensor.get("angle_step")
    if view is not None:
        steps = "" if step is None else f", {math.degrees(abs(step)):g} deg apart"
        yield _row("  field of view", f"{view[0]:.2f} to {view[1]:.2f} deg{steps}")
    if "x" in (place := sensor.get("extrinsics") or {}):
        form = "x {x:.3f} m, y {y:.3f} m, turned {theta_deg:.2f} deg ({how})"
        yield _row("  on the robot", form.format(**place))
    if sensor.get("upside_down"):
        yield _row("  upside down", f"beams turn clockwise ({sensor.get('upside_down_how', '')})")
    if not (rule := sensor.get("ranges")):
        return
    limit = "none" if rule["threshold"] is None else f"{rule['threshold']:g} m"
    yield _row("  maximum range", f"{limit}: {rule['threshold_how']}")
    if rule["free_range"] is not None:
        text = f"{rule['free_range']:g} m by a maximum-range beam: {rule['free_how']}"
        yield _row("  shown free", text)
    for first, last, limit in rule.get("self_filter", ()):
        text = f"beams {first} to {last} end on it: unusable up to {limit:g} m"
        yield _row("  robot itself", text)
    yield _row("  zero means", f"{rule['zero_means']}: {rule['zero_how']}")


def _format_notes(info: dict[str, Any]) -> Iterator[str]:
    if info["params"]:
        yield _row("PARAM", ", ".join(f"{k} {v}" for k, v in info["params"].items()))
    if info["ignored"]:
        yield _row("ignored lines", ", ".join(f"{v} {k}" for k, v in info["ignored"].items()))
    for topic in info["topics"]:
        kind = str(topic["type"]).rpartition("/")[2]
        yield _row("topic", f"{topic['topic']} ({kind}, {topic['messages']}): {topic['why']}")
    for what in info["duplicates"]:
        yield _row("left out", what)
    unit = info["skipped_unit"]
    kinds = (("skipped", "scans", unit), ("skipped_odometry", "odometry", unit), ("damage", "", ""))
    for key, of, unit in kinds:
        for reason, damage in info[key].items():
            shown = ", ".join(str(line) for line in damage["lines"][:_LINES_SHOWN])
            more = ", ..." if damage["count"] > _LINES_SHOWN else ""
            title = f"skipped {of}" if of else key
            yield _row(title, f"{damage['count']} {reason} ({unit or 'at byte'} {shown}{more})")
    for what in info["warnings"]:
        yield _row("warning", what)


def _row(title: str, text: str) -> str:
    return f"{title:<16}  {text}"
