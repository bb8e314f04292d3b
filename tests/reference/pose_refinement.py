"""Twin of the kernel that refines one scan after another."""

import numpy as np

from stillmap.core import se2
from stillmap.slam import scan_hits, scan_matching
from stillmap.slam.motion_model import MotionPrior


def refine_scans(grid, recording, e, is_in_map, poses, increments, std, has_step, own_pose_std):
    """Poses (T, 3, 3), covariances and explained shares of all scans; the first one is fixed.

    increments (T, 3, 3), std (T, 2), has_step (T,): from each scan to the next.
    """
    poses = poses.copy()
    covariance, explained = np.zeros((len(poses), 3, 3)), np.ones(len(poses))
    for t in range(1, len(poses)):
        if is_in_map[t]:
            scan_hits.add_scan(grid, recording, e, t, poses[t], remove=True)
        gaussians = []
        if has_step[t - 1]:
            gaussians.append((poses[t - 1] @ increments[t - 1], std[t - 1]))
        if has_step[t]:
            gaussians.append((poses[t + 1] @ np.linalg.inv(increments[t]), std[t]))
        prior = product(gaussians or [(poses[t], own_pose_std)])
        scan = scan_hits.select_hits(recording, e, t)
        match = scan_matching.refine_pose(grid, scan, prior, poses[t])
        poses[t], covariance[t], explained[t] = match.T_map_base, match.covariance, match.explained
        if is_in_map[t]:
            scan_hits.add_scan(grid, recording, e, t, poses[t])
    return poses, covariance, explained


def product(gaussians):
    """The product of Gaussians: poses (3, 3) with standard deviations in m and rad."""
    first = se2.parameters(gaussians[0][0])
    information, pull = np.zeros((3, 3)), np.zeros(3)
    for mean, (translation, rotation) in gaussians:
        own = np.diag([translation, translation, rotation]) ** 2
        own[own > 0] = 1 / own[own > 0]
        apart = se2.parameters(mean) - first
        apart[2] = se2.wrap(apart[2])
        information += own
        pull += own @ apart
    mean = se2.matrix(*(first + np.linalg.solve(information, pull)))
    return MotionPrior(mean, information, 0.0, 0.0)
