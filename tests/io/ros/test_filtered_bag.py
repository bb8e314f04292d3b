"""Filtered copies of bags."""

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from small_bags import write_bag

from stillmap.io import read
from stillmap.io.ros import recording_writer
from stillmap.io.ros.messages import load_typestore
from stillmap.preprocessing.options import ReadOptions

START = 1_700_000_000_000_000_000
SECOND = 10**9


def scans(messages, n=6):
    content = []
    for k in range(n):
        stamp = START + k * SECOND
        changes = {"angle_increment": 0.0} if k == 2 else {}
        scan = messages.scan(stamp, 2.0 + 0.1 * np.arange(5) + k, **changes)
        content.append(("/scan", stamp, scan))
        odometry = messages.odometry(stamp, (k, 0, 0), (0, 0, 0, 1))
        content.append(("/odom", stamp, odometry))
    return content


def contents(path, messages):
    with AnyReader([path], default_typestore=load_typestore(messages.encoding)) as reader:
        return [
            (c.topic, log_ns, reader.deserialize(raw, c.msgtype))
            for c, log_ns, raw in reader.messages()
        ]


def test_other_messages_are_copied(bag, messages, tmp_path):
    source = bag(scans(messages))
    recording = read(source)
    blank = np.zeros(recording.n_beams, np.bool_)
    blank[[1, 7, 8]] = True  # of the first and the second scan
    out = tmp_path / f"out{source.suffix}"
    done = recording_writer.write_filtered_bag(source, out, recording, blank, ReadOptions())
    assert (done.omitted, done.omitted_topics) == (1, [])
    before, after = contents(source, messages), contents(out, messages)
    damaged = [one for one in before if one[0] == "/scan"][2]
    before.remove(damaged)
    assert [one[:2] for one in after] == [one[:2] for one in before]
    got = np.stack([m.ranges for topic, _, m in after if topic == "/scan"]).ravel()
    expected = np.stack([m.ranges for topic, _, m in before if topic == "/scan"]).ravel()
    np.testing.assert_array_equal(np.flatnonzero(np.isinf(got)), [1, 7, 8])
    np.testing.assert_array_equal(got[~blank], expected[~blank])
    again = read(out)
    np.testing.assert_array_equal(again.hit, recording.hit & ~blank)
    np.testing.assert_array_equal(again.T_odom_base, recording.T_odom_base)


@pytest.mark.parametrize("zeros", [20, 0])
def test_the_no_return_code_of_the_laser_is_used(bag, messages, tmp_path, zeros):
    """Zeros are frequent: added infinities must not make them unusable."""
    rng = np.random.default_rng(0)
    content = []
    for k in range(8):
        ranges = rng.uniform(2.0, 9.0, 100)
        ranges[rng.permutation(100)[:zeros]] = 0.0
        stamp = START + k * SECOND
        content.append(("/scan", stamp, messages.scan(stamp, ranges)))
    source = bag(content)
    recording = read(source)
    blank = recording.hit & (rng.random(recording.n_beams) < 0.3)
    out = tmp_path / f"out{source.suffix}"
    recording_writer.write_filtered_bag(source, out, recording, blank, ReadOptions())
    got = np.concatenate([m.ranges for _, _, m in contents(out, messages)])
    assert (got[blank] == (0.0 if zeros else np.inf)).all()
    again = read(out)
    rules = [one.source["sensors"][0]["ranges"]["zero_means"] for one in (recording, again)]
    assert rules == ["max-range" if zeros else "unusable"] * 2
    np.testing.assert_array_equal(again.hit, recording.hit & ~blank)
    assert np.isfinite(again.points).all()


def test_two_lasers_and_an_unused_one(bag, messages, tmp_path):
    mounts = [messages.transform(0, "base_link", name, (0, 0, 0)) for name in ("a", "b")]
    content = [("/tf_static", START, messages.tf(*mounts))]
    for k in range(5):
        stamp = START + k * SECOND
        for j, name in enumerate(("a", "b", "elsewhere")):
            scan = messages.scan(stamp + j, np.full(4, 3.0 + j), name)
            content.append((f"/{name}", stamp + j, scan))
    source = bag(content)
    recording = read(source)
    assert recording.n_scans == 10
    blank = np.zeros(recording.n_beams, np.bool_)
    blank[recording.beams_of(3)] = True  # of the second laser
    out = tmp_path / f"out{source.suffix}"
    done = recording_writer.write_filtered_bag(source, out, recording, blank, ReadOptions())
    assert done.unfiltered_topics == ["/elsewhere"]
    infinite = [
        (topic, log_ns)
        for topic, log_ns, m in contents(out, messages)
        if topic != "/tf_static" and np.isinf(m.ranges).all()
    ]
    assert infinite == [("/b", START + SECOND + 1)]
    elsewhere = [topic for topic, _, _ in contents(out, messages) if topic == "/elsewhere"]
    assert len(elsewhere) == 5


def test_unknown_types_are_copied(tmp_path, kind, messages):
    """The bag holds their definitions."""
    from rosbags.typesys import get_types_from_msg

    own = "strange_msgs/msg/Thing"
    messages.store.register(get_types_from_msg("int32 number\nstring words\n", own))
    try:
        thing = messages.make(own, 7, "seven")
        content = [*scans(messages, 3)[:4], ("/thing", START, (own, thing))]
        source = write_bag(tmp_path, kind, messages, content)
        del messages.store.fielddefs[own]
        recording = read(source)
        out = tmp_path / f"out{source.suffix}"
        blank = np.zeros(recording.n_beams, np.bool_)
        assert (
            recording_writer.write_filtered_bag(
                source, out, recording, blank, ReadOptions()
            ).omitted_topics
            == []
        )
        things = [m for topic, _, m in contents(out, messages) if topic == "/thing"]
        assert [(m.number, m.words) for m in things] == [(7, "seven")]
    finally:
        messages.store.fielddefs.pop(own, None)


def test_cut_bag(bag, messages, kind, tmp_path):
    if kind not in ("bag", "mcap"):
        pytest.skip("SQLite files have no end that could be missing")
    source = bag(scans(messages, 40))
    content = source.read_bytes()
    source.write_bytes(content[: int(0.7 * len(content))])
    recording = read(source)
    out = tmp_path / f"out{source.suffix}"
    blank = np.zeros(recording.n_beams, np.bool_)
    blank[3] = True
    recording_writer.write_filtered_bag(source, out, recording, blank, ReadOptions())
    np.testing.assert_array_equal(read(out).hit, recording.hit & ~blank)
