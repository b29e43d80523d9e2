"""What no sensor determines, and has to be held for a rig problem to have one answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rigwake.ba.solver.rig_problem import DistanceMeasurement, PoseMeasurements, RigProblem

_SCALE_STD = 0.005  # share: what the scale of an external metric trajectory is trusted with
_HELD_STD = 1e-4  # of heading (rad) and position (m) of the first state


def with_gauge(problem: RigProblem) -> RigProblem:
    """The problem with its gauge held at the first state, in place of whatever held it before.

    GNSS gives the world. Without it an IMU gives roll and pitch, and heading and position are held. Without both,
    the first state is held, and the way to the state farthest from it gives the scale, unless a baseline does.
    """
    if problem.gnss is not None:
        return problem
    states = problem.states
    if problem.imu is not None:
        held = [1.0, 1.0, *[_HELD_STD] * 4]
        return replace(problem, poses=PoseMeasurements.of_first_state(states.world_from_rig[0], held))
    fixed = np.zeros(len(states), dtype=bool)
    fixed[0] = True
    problem = replace(problem, states=replace(states, fixed=fixed))
    if problem.baselines or problem.camera_distances:
        return replace(problem, distances=())
    reach = np.linalg.norm(states.world_from_rig.translation - states.world_from_rig.translation[0], axis=1)
    farthest = int(reach.argmax())
    distance = float(reach[farthest])
    measured = DistanceMeasurement(0, farthest, distance, _SCALE_STD * distance)
    return replace(problem, distances=(measured,) if distance > 0 else ())
