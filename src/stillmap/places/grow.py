"""Growth of a place by one session: alignment, then EM over sessions.

M-step: constraints between keyframes given P(static), and the pose graph of all sessions. E-step:
the evidence of each session, and the chain over sessions for each cell.
"""

from dataclasses import replace

import numpy as np

from stillmap.core import se2, se3
from stillmap.core.array_types import Float
from stillmap.core.local_frame import shift_poses
from stillmap.core.profiling import Progress, no_progress
from stillmap.io.trajectory import embed_in_3d
from stillmap.places.keyframes import Keyframes, Session
from stillmap.places.place import (
    Place,
    PlacedSession,
    Tie,
    combine_covariances,
    optimize_nodes,
    update_evidence,
)
from stillmap.places.place_states import PlaceStates, estimate_place, measure_overlap
from stillmap.places.placement import (
    CORRECTED_STD,
    PREDICTION_STD,
    KeyframeMatch,
    Placement,
    Verdict,
    find_placement,
    match_sessions,
    match_sweeps,
    select_references,
)
from stillmap.places.surface_map import compare_maps, make_surface_map

_MIN_NODES, _MIN_SPREAD = 8, 5.0  # nodes, and their spread in m, from which on tilt is estimated
_MAX_TILT = 0.1  # rad
_REACH = 20.0  # m between nodes at which the ground is the same


def lift_alignment(place: Place, session: Session, placement: Placement) -> Float:
    """(N, D+1, D+1) poses of a session's nodes in the place, by an alignment in the plane.

    In 3D, height and tilt are those at which the ground lies as the place knows it: the base of
    two keyframes near each other is as high above it as each was.
    """
    if session.dimension == 2:
        return placement.T @ session.node_poses
    nodes = embed_in_3d(placement.T) @ session.node_poses
    clearance = session.clearance[session.keyframes.nodes]
    at, rise = [np.zeros((0, 3))], [np.zeros(0)]
    for known in place.sessions:
        theirs, their_clearance = known.nodes, known.session.clearance
        distance = np.linalg.norm(nodes[:, None, :2, 3] - theirs[None, :, :2, 3], axis=2)
        nearest = distance.argmin(axis=1)
        near = np.flatnonzero(distance.min(axis=1) <= _REACH)
        of = nearest[near]
        ground = theirs[of, 2, 3] - their_clearance[known.session.keyframes.nodes[of]]
        at.append(nodes[near, :3, 3])
        rise.append(ground + clearance[near] - nodes[near, 2, 3])
    return _tilt(np.concatenate(at), np.concatenate(rise)) @ nodes


def _tilt(at: Float, rise: Float) -> Float:
    """(4, 4) small motion that lifts points (n, 3) by (n,) metres, robustly."""
    if not len(at):
        return np.eye(4)
    centre, height = at.mean(axis=0), float(np.median(rise))
    offset = at[:, :2] - centre[:2]
    slope = np.zeros(2)
    if len(at) >= _MIN_NODES and offset.std(axis=0).min() >= _MIN_SPREAD:
        kept = np.abs(rise - height) <= 3.0 * np.median(np.abs(rise - height)) + 1e-3
        columns = np.column_stack([offset[kept], np.ones(int(kept.sum()))])
        fit = np.linalg.lstsq(columns, rise[kept], rcond=None)[0]
        slope, height = np.clip(fit[:2], -_MAX_TILT, _MAX_TILT), float(fit[2])
    # a rotation vector (slope_y, -slope_x, 0) raises a point by its offset times the slope
    turn = se3.exp(np.array([0.0, 0.0, height, slope[1], -slope[0], 0.0]))
    to_centre, back = (shift_poses(np.eye(4), by) for by in (centre, -centre))
    return np.asarray(to_centre @ turn @ back)


Matches = dict[int, list[KeyframeMatch]]  # by the index of the reference in the place

_EM_ROUNDS = 2
_MAX_MOTION = 1.0  # cells: what the E-step between two M-steps does not notice
# share of the surfaces seen by a session and others that may differ at its optimized poses; more
# than by its alignment, which leaves it in one piece
_MAX_DIFFERING = 0.2
# constraints between keyframes, and the share of them that the graph must keep; in 3D the maps
# themselves are one: lidars see far beyond where robots drove
_MIN_TIES, _MIN_AGREEING = 4, 0.6
# in 3D, where maps alone leave a doubt: mean share of a sweep that submaps may leave unexplained,
# as such and relative to any other alignment; most of a sweep is ground, which fits anywhere
_MAX_UNEXPLAINED, _MAX_UNEXPLAINED_RATIO = 0.4, 0.6
# m and rad, of an alignment of maps
_MAP_STD = {2: (0.04, 0.04, 0.003), 3: (0.05, 0.05, 0.1, 0.01, 0.01, 0.004)}


def start_place(session: Session, resolution: float, voxel_size: float, threads: int) -> Place:
    """A place of one session, in its frame."""
    first = _place_session(session, session.node_poses)
    return update_evidence(Place([first], [], resolution, voxel_size), threads)


def _place_session(session: Session, nodes: Float) -> PlacedSession:
    """A session at poses of its nodes that count as certain."""
    dof = 3 * (session.dimension - 1)
    return PlacedSession(session, nodes, np.zeros((dof, dof)))


def add_session(
    place: Place, session: Session, threads: int, report: Progress = no_progress
) -> tuple[Place, str]:
    """Add a session to a place, if the evidence is clear about where it lies.

    Args:
        place: at least one session, with evidence.
        session: of the same dimension.
        threads: the result does not depend on it.
        report: called with the step that begins.

    Returns:
        the place with the session, or as it was; and why the session is not in it, if it is not.
    """
    report("aligning", 0, 0, 0)
    placement = find_placement(place.sessions, session)
    if placement.refused and not placement.rivals:
        return place, placement.refused
    start = placed = _place_session(session, lift_alignment(place, session, placement))
    matches, states = placement.matches, None
    if place.dimension == 3:
        matches = match_session(place, placed, PREDICTION_STD, None, threads)
        if placement.rivals and not _beats_rivals(place, session, placement, matches, threads):
            return place, placement.refused
    for number in range(_EM_ROUNDS):
        if states is not None:
            matches = match_session(place, placed, CORRECTED_STD, states, threads)
        report("optimizing poses", 0, 0, 0)
        ties = make_ties(matches, len(place.sessions))
        if place.dimension == 3 or not placement.matches:
            ties.append(_tie_maps(place, start))
        elif len(ties) < _MIN_TIES:
            return place, "too few of its keyframes can be registered to the place"
        grown, agreeing = _optimize(place, placed, ties)  # M-step
        if agreeing < _MIN_AGREEING:
            return place, "constraints to the place contradict each other"
        placed = grown.sessions[-1]
        if number + 1 == _EM_ROUNDS:
            break
        report("comparing sessions", 0, 0, 0)
        grown = update_evidence(grown, threads, _MAX_MOTION)
        states = estimate_planar(grown)  # E-step
        if place.dimension == 2 and (differ := _differing_share(grown)) > _MAX_DIFFERING:
            why = f"{100 * differ:.0f} % of the surfaces that both saw differ after optimization"
            return place, f"it contradicts the place: {why}"
    return _describe(update_evidence(grown, threads), ties), ""


def _differing_share(place: Place) -> float:
    """Share of the surfaces seen by the last session and by others in conflict."""
    *known, last = [placed.require_evidence()[1] for placed in place.sessions]
    maps = make_surface_map(known), make_surface_map([last])
    agree, conflict = compare_maps(*maps, np.eye(3))
    return conflict / max(agree + conflict, 1)


def _beats_rivals(
    place: Place, session: Session, placement: Placement, matches: Matches, threads: int
) -> bool:
    """True if an alignment, with these matches, leaves far less unexplained than others do."""
    unexplained = _unexplained_share(matches)
    if unexplained > _MAX_UNEXPLAINED:
        return False
    for T in placement.rivals:
        nodes = lift_alignment(place, session, replace(placement, T=T))
        rival = match_session(place, _place_session(session, nodes), PREDICTION_STD, None, threads)
        if unexplained > _MAX_UNEXPLAINED_RATIO * _unexplained_share(rival):
            return False
    return True


def _unexplained_share(matches: Matches) -> float:
    """Mean share of a sweep that the submaps do not explain; 1 where few were matched."""
    shares = [1.0 - match.closure.explained for of in matches.values() for match in of]
    return float(np.mean(shares)) if len(shares) >= _MIN_TIES else 1.0


def estimate_planar(place: Place) -> PlaceStates:
    """The states of the cells in the plane, over the sessions in the order of time."""
    return estimate_place([placed.require_evidence()[1] for placed in place.in_time()])


def match_session(
    place: Place,
    placed: PlacedSession,
    std: tuple[float, float],
    states: PlaceStates | None,
    threads: int,
) -> Matches:
    """The nodes of a session matched with its references at its poses in the place.

    Args:
        place: without the session.
        placed: the session.
        std: m and rad, of its poses.
        states: of the place with the session: what changed has no weight; None: not known.
        threads: the result does not depend on it.
    """
    session, planar_poses = placed.session, placed.planar_poses
    nodes = list(range(len(session.keyframes.nodes)))
    out = {}
    for index in select_references(place.sessions, session.planar, planar_poses):
        reference = place.sessions[index]
        if place.dimension == 3:
            out[index] = match_sweeps(reference, placed, std, nodes, threads)
            continue
        out[index] = match_sessions(
            _weigh(reference.session.planar, reference.planar_poses, states),
            reference.planar_poses,
            _weigh(session.planar, planar_poses, states),
            planar_poses,
            std,
            nodes,
        )
    return out


def _weigh(keyframes: Keyframes, poses: Float, states: PlaceStates | None) -> Keyframes:
    """Keyframes whose beams that ended on what changes between sessions have no weight."""
    if states is None:
        return keyframes
    recording = keyframes.recording
    beams = np.flatnonzero(recording.hit)
    p_changing = states.look_up(recording.end_points(beams, poses), states.states.p_changing)
    e = np.array(keyframes.e)
    e[beams] *= (1.0 - p_changing).astype(np.float32)
    return replace(keyframes, e=e)


def make_ties(matches: Matches, index: int) -> list[Tie]:
    """The constraints of keyframes that fit, between references and session `index`."""
    return [
        Tie(reference, match.nearest, index, match.node, match.closure.T, match.closure.covariance)
        for reference, of in matches.items()
        for match in of
        if match.verdict is Verdict.FITS
    ]


def _tie_maps(place: Place, start: PlacedSession) -> Tie:
    """The alignment of the maps as a constraint between the nearest nodes."""
    index = select_references(place.sessions, start.session.planar, start.planar_poses)[0]
    D = place.dimension
    ours, theirs = start.nodes[:, :D, D], place.sessions[index].nodes[:, :D, D]
    distance = np.linalg.norm(ours[:, None] - theirs[None], axis=2)
    node, reference_node = np.unravel_index(int(distance.argmin()), distance.shape)
    T = se2.inverse(place.sessions[index].nodes[reference_node]) @ start.nodes[node]
    covariance = np.diag(np.square(_MAP_STD[D]))
    return Tie(index, int(reference_node), len(place.sessions), int(node), T, covariance)


def _optimize(place: Place, placed: PlacedSession, ties: list[Tie]) -> tuple[Place, float]:
    """The place with a further session after pose graph optimization, and the share of the new
    ties that agree with it."""
    sessions = [*place.sessions, placed]
    all_ties = [*place.ties, *ties]
    start = [each.nodes for each in sessions]
    nodes, agree = optimize_nodes([each.session for each in sessions], start, all_ties)
    kept = [tie for tie, agrees in zip(all_ties, agree.tolist(), strict=True) if agrees]
    grown = replace(place, sessions=sessions, ties=kept).with_nodes(nodes)
    return grown, float(agree[len(place.ties) :].mean())


def _describe(place: Place, ties: list[Tie]) -> Place:
    """The place with covariance and overlap of its last session."""
    *before, placed = place.sessions
    planar = [each.require_evidence()[1] for each in place.sessions]
    nodes = placed.session.node_poses
    # at its first scan and in its frame
    own = (se2.inverse(nodes[0]) @ nodes)[[tie.second_node for tie in ties]]
    covariance = combine_covariances(own, [tie.covariance for tie in ties])
    overlap = measure_overlap(planar, len(before))
    last = replace(placed, covariance=covariance, overlap=overlap)
    return replace(place, sessions=[*before, last])
