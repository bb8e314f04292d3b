"""Consistency of loop closures: those nearby must ask for the same correction."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.slam.pose_graph import Constraint
from stillmap.slam.types import LoopClosure, LoopContext

Float = NDArray[np.float64]

# keyframe distances on the earlier and the later side that count as nearby, closures nearby that
# must agree, chi-square up to which two agree
_NEARBY = np.array([8.0, 4.0])
_MIN_AGREEING, _MAX_AGREEMENT_CHI2 = 2, 9.0


def reject_inconsistent(
    context: LoopContext, chain: list[Constraint], closures: list[LoopClosure]
) -> list[LoopClosure]:
    """Rejects closures whose correction those nearby do not share.

    At least `_MIN_AGREEING` closures nearby and half of them all must agree.
    """
    accepted = _AcceptedLoops.collect(context, chain, closures)
    at, nearby = context.travelled[accepted.scans], _NEARBY * context.keyframe_distance
    out, n = [], 0
    for closure in closures:
        if not closure.rejected:
            others = np.flatnonzero((np.abs(at - at[n]) < nearby).all(axis=1))
            others = others[others != n]
            n_agreeing = np.count_nonzero(accepted.agree(n, others))
            if n_agreeing < max(_MIN_AGREEING, len(others) / 2):
                closure = closure.reject("nearby closures disagree")
            n += 1
        out.append(closure)
    return out


def reject_inconsistent_since(
    context: LoopContext,
    chain: list[Constraint],
    attempted: list[LoopClosure],
    decided: list[LoopClosure],
    k: int,
) -> list[LoopClosure]:
    """`reject_inconsistent` of all attempts, when those from keyframe k on are new.

    Args:
        context, chain: as of `reject_inconsistent`.
        attempted: all attempts, by the later scan.
        decided: the result of those before keyframe k.
        k: index into the keyframes.
    """
    later = [context.travelled[closure.later] for closure in attempted]
    near = _NEARBY[1] * context.keyframe_distance
    # new votes reach back one neighborhood, whose closures depend on one more
    here = context.travelled[context.keyframes[k]]
    changed, relevant = np.searchsorted(later, here - [near, 2 * near])
    again = reject_inconsistent(context, chain, attempted[relevant:])
    return decided[:changed] + again[changed - relevant :]


@dataclass(frozen=True, eq=False)
class _AcceptedLoops:
    """Loop closures that are not rejected, as arrays.

    Attributes:
        scans: (L, 2) earlier and later scan.
        T: (L, 3, 3) as of LoopClosure.
        P_earlier, P_later: (L, 3, 3) T_map_base of the scans by the context.
        covariance: (L, 3, 3) as of LoopClosure.
        accumulated: (L, 3, 3) sum of the covariances of the steps to the later scan, along the
            map's axes.
    """

    scans: NDArray[np.intp]
    T: Float
    P_earlier: Float
    P_later: Float
    covariance: Float
    accumulated: Float

    @classmethod
    def collect(
        cls, context: LoopContext, chain: list[Constraint], closures: list[LoopClosure]
    ) -> "_AcceptedLoops":
        accepted = [closure for closure in closures if not closure.rejected]
        scans = np.array([[c.earlier, c.later] for c in accepted], np.intp).reshape(-1, 2)
        T, covariance = (
            np.array(of_each).reshape(-1, 3, 3)
            for of_each in ([c.T for c in accepted], [c.covariance for c in accepted])
        )
        at = np.searchsorted(context.keyframes, scans[:, 1])
        accumulated = _accumulate_covariance(context, chain)[at]
        P = context.poses[scans]
        return cls(scans, T, P[:, 0], P[:, 1], covariance, accumulated)

    def agree(self, n: int, others: NDArray[np.intp]) -> NDArray[np.bool_]:
        """(K,) whether loop n and others (K,) fit the motion between their later scans."""
        is_first = self.scans[n, 1] <= self.scans[others, 1]
        a, b = np.where(is_first, n, others), np.where(is_first, others, n)
        back = se2.inverse(self.P_later[b])
        predicted = self.P_earlier[a] @ self.T[a] @ se2.inverse(self.P_later[a]) @ self.P_later[b]
        d = se2.parameters(se2.inverse(predicted) @ self.P_earlier[b] @ self.T[b])
        between = self.accumulated[b] - self.accumulated[a]
        between += se2.rotate_covariance(self.covariance[a], self.P_later[a])
        covariance = self.covariance[b] + se2.rotate_covariance(between, back)
        chi2 = (d * np.linalg.solve(covariance, d[..., None])[..., 0]).sum(axis=1)
        return np.asarray(chi2 < _MAX_AGREEMENT_CHI2)


def _accumulate_covariance(context: LoopContext, chain: list[Constraint]) -> Float:
    """(K, 3, 3) sum of the covariances of the steps to each keyframe, along the map's axes."""
    poses = context.poses[context.keyframes[1:]]
    steps = np.array([constraint.covariance for constraint in chain]).reshape(-1, 3, 3)
    out = np.zeros((len(context.keyframes), 3, 3))
    np.cumsum(se2.rotate_covariance(steps, poses), axis=0, out=out[1:])
    return out
