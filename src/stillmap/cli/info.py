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


def _format_summary(found: dict[str, Any]) -> Iterator[str]:
    yield f"{found['input']}: {found['format'] or 'stillmap recording'}, {found['dimension']}D"
    if found["path"] not in (None, found["input"]):
        yield _row("made from", str(found["path"]))
    beams = found["beams_per_scan"]
    if beams is None:
        yield _row("scans", "none")
        return
    per_scan = f"{beams['median']:.0f}"
    if beams["min"] != beams["max"]:
        per_scan += f" ({beams['min']:.0f} to {beams['max']:.0f})"
    scans = f"{found['scans']} with {per_scan} beams each, {found['beams']} beams"
    yield _row("scans", f"1 with {found['beams']} beams" if found["scans"] == 1 else scans)
    shares = found["counts"]["shares"]
    words = (("hits", "hits"), ("max_range", "maximum range"), ("unusable", "unusable"))
    yield _row("beams", ", ".join(f"{100 * shares[key]:.2f} % {word}" for key, word in words))
    spread = found["hit_ranges_m"]
    if spread is not None:
        yield _row(
            "ranges of hits",
            "min {min:.2f}, median {median:.2f}, 99 % {p99:.2f}, max {max:.2f} m".format(**spread),
        )
    yield from _format_time(found["time"])
    if found["part"]:
        yield _row("part", _format_part(found["part"]))
    if found["beam_times_s"] is not None:
        first, last = found["beam_times_s"]
        how = f", as it turns {found['spin']}" if found["spin"] else ""
        yield _row("beam times", f"{first:g} to {last:g} s after a scan's stamp{how}")
    elif found["dimension"] == 3 and found["scans"] > 1:
        yield _row("beam times", "none")
    yield from _format_odometry(found["odometry"])
    yield from _format_poses_and_images(found)
    if found["base_frame"] is not None:
        yield _row("robot's frame", f"{found['base_frame']} ({found['base_frame_how']})")
    for sensor in found["sensors"]:
        yield from _format_sensor(sensor)
    for box in found["self_filter"]:
        yield _row("robot itself", _format_self_filter(box, found))
    yield from _format_notes(found)


def _format_time(time: dict[str, Any]) -> Iterator[str]:
    from stillmap.core.timestamps import format_seconds

    first, last = (format_seconds(time[key]) for key in ("first_stamp_ns", "last_stamp_ns"))
    rate = f", {time['rate_hz']:.2f} scans/s" if time["rate_hz"] else ""
    gap = f", largest gap {time['largest_gap_s']:.2f} s" if time["largest_gap_s"] else ""
    yield _row("duration", f"{time['duration_s']:.2f} s{rate}{gap}")
    yield _row("stamps", f"{first} to {last}")


def _format_part(part: dict[str, Any]) -> str:
    """The scans that the time window leaves out of a recording."""
    from stillmap.core.timestamps import format_seconds

    first, last = part.get("first_stamp_ns"), part.get("last_stamp_ns")
    if not isinstance(first, int) or not isinstance(last, int):
        return "of a longer recording"
    stamps = f"stamps {format_seconds(first)} to {format_seconds(last)}"
    return f"of {(last - first) / 1e9:.2f} s, {stamps}; {part.get('omitted')} scans left out"


def _format_odometry(odometry: dict[str, Any] | None) -> Iterator[str]:
    if odometry is None:
        yield _row("odometry", "none")
        return
    origin = f", from {odometry['from']}" if "from" in odometry else ""
    yield _row(
        "odometry",
        f"path {odometry['path_length_m']:.2f} m, turned {odometry['turned_deg']:.0f} deg{origin}",
    )
    from stillmap.core.timestamps import format_seconds

    at = odometry["largest_step_at_ns"]
    if at is not None:
        yield _row(
            "largest step",
            f"{odometry['largest_step_m']:.3f} m (after {format_seconds(at)}), "
            f"{odometry['largest_step_deg']:.1f} deg",
        )


def _format_poses_and_images(found: dict[str, Any]) -> Iterator[str]:
    """Recorded poses and images, where there are any."""
    way, images = found["recorded_poses"], found["images"]
    if way is not None:
        text = f"path {way['path_length_m']:.2f} m, turned {way['turned_deg']:.0f} deg"
        yield _row("recorded poses", f"{text}: used with --poses recording")
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
    view = sensor.get("field_of_view_deg")
    if view is not None:
        step = sensor.get("angle_step")
        steps = f", {math.degrees(abs(step)):g} deg apart" if isinstance(step, float) else ""
        yield _row("  field of view", f"{view[0]:.2f} to {view[1]:.2f} deg{steps}")
    place = sensor.get("extrinsics")
    if place is not None and "x" in place:
        yield _row(
            "  on the robot",
            f"x {place['x']:.3f} m, y {place['y']:.3f} m, turned {place['theta_deg']:.2f} deg "
            f"({place['how']})",
        )
    if sensor.get("upside_down"):
        yield _row("  upside down", f"beams turn clockwise ({sensor.get('upside_down_how', '')})")
    rule = sensor.get("ranges")
    if rule is not None:
        threshold = rule["threshold"]
        limit = "none" if threshold is None else f"{threshold:g} m"
        yield _row("  maximum range", f"{limit}: {rule['threshold_how']}")
        if rule["free_range"] is not None:
            yield _row(
                "  shown free",
                f"{rule['free_range']:g} m by a maximum-range beam: {rule['free_how']}",
            )
        for first, last, limit in rule.get("self_filter", ()):
            text = f"beams {first} to {last} end on it: unusable up to {limit:g} m"
            yield _row("  robot itself", text)
        yield _row("  zero means", f"{rule['zero_means']}: {rule['zero_how']}")


def _format_self_filter(box: dict[str, Any], found: dict[str, Any]) -> str:
    """The box of a lidar's returns from its robot."""
    of = f" of sensor {box['sensor'] + 1}" if len(found["sensors"]) > 1 else ""
    spans = zip("xyz", box["low"], box["high"], strict=True)
    where = ", ".join(f"{axis} {low:g} to {high:g}" for axis, low, high in spans)
    return f"{box['beams']} beams{of} end on it: unusable; {where} m from the sensor"


def _format_notes(found: dict[str, Any]) -> Iterator[str]:
    if found["params"]:
        yield _row("PARAM", ", ".join(f"{k} {v}" for k, v in found["params"].items()))
    if found["ignored"]:
        yield _row("ignored lines", ", ".join(f"{v} {k}" for k, v in found["ignored"].items()))
    for topic in found["topics"]:
        if isinstance(topic, dict) and {"topic", "type", "messages", "why"} <= set(topic):
            kind = str(topic["type"]).rpartition("/")[2]
            text = f"{topic['topic']} ({kind}, {topic['messages']}): {topic['why']}"
            yield _row("topic", text)
    for what in found["duplicates"]:
        yield _row("left out", what)
    numbered = found["skipped_unit"]
    kinds = (
        ("skipped", "skipped scans", numbered),
        ("skipped_odometry", "skipped odometry", numbered),
        ("damage", "damage", "at byte"),
    )
    for key, title, what in kinds:
        for reason, damage in found[key].items():
            shown = ", ".join(str(line) for line in damage["lines"][:_LINES_SHOWN])
            more = ", ..." if damage["count"] > _LINES_SHOWN else ""
            yield _row(title, f"{damage['count']} {reason} ({what} {shown}{more})")
    for what in found["warnings"]:
        yield _row("warning", what)


def _row(title: str, text: str) -> str:
    return f"{title:<16}  {text}"
