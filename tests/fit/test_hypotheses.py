"""The search among hypotheses, on costs whose minima are known, and how the posterior divides among modes."""

import math

import pytest
import torch
from brackets import about_center, camera, rotation, task_of
from photographs import photograph

import edgegrad as eg
from edgegrad.fit.options import Settings
from edgegrad.fit.placement import angle, pose_from_matrix
from edgegrad.fit.pose import hypotheses
from edgegrad.fit.pose.camera_motion import moved_poses
from edgegrad.fit.pose.hypotheses import Group, HypothesisSearch, Mode, probabilities, turned
from edgegrad.fit.pose.pose_search import ambiguous
from edgegrad.fit.pose.replay_log import ReplayLog
from edgegrad.fit.pose.settings import POSE
from edgegrad.optim.levenberg_marquardt import Model, Problem

F64 = torch.float64
RIGHT, WRONG = (pose_from_matrix("init", about_center(rotation(0.0, 0.0, z), (z, 0.0, 0.0))) for z in (0.5, -0.4))
START = pose_from_matrix("init", about_center(rotation(0.02, 0.01, 0.0)))
STIFF = torch.tensor([1e4, 2e4, 3e4, 1.5e4, 2.5e4, 1e3], dtype=F64)


def numbers(pose):
    return [field.tolist() for field in pose]


class KnownMinima(Problem):
    """The least of several paraboloids in the places of poses, as a level of pictures."""

    coarseness, size = 1.0, (64, 64)

    def __init__(self, task, minima, last):
        self.task, self.minima, self.last, self.dofs = task, minima, last, tuple(task.dofs) if task else ()
        self.contour_noises, self.temperature = (), 1.0

    def informed(self, poses):
        return self

    def focused(self, pose):
        self.temperature = T
        return self

    def moved(self, points, steps):
        return moved_poses(self.task, points, self.dofs, steps)

    def place(self, pose, end):
        """Return rotation vector and shift from an end (6,)."""
        R, view = pose.R @ end.R.T, self.task.shots[0].camera.world_to_camera[:3, :3].double()
        axis = torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
        axis = axis * (angle(end.R, pose.R) / axis.norm().clamp(min=1e-12))
        shift = self.task.center_at(pose) - self.task.center_at(end)
        return torch.cat([view @ axis, view @ shift / self.task.size])

    def model(self, points):
        """Return the models, whose derivatives are exact in the minima, and along rotations about one axis."""
        costs, gradients, curvatures = [], [], []
        for pose in points:
            places = [
                (cost, self.place(pose, end), STIFF * (factor[0] if factor else 1.0))
                for cost, end, *factor in self.minima
            ]
            found = ((c + 0.5 * float(x.square() @ stiff), x, stiff) for c, x, stiff in places)
            cost, place, stiff = min(found, key=lambda one: one[0])
            costs.append([cost])
            gradients.append(stiff * place)
            curvatures.append(stiff.diag())
        return Model(torch.tensor(costs, dtype=F64), torch.stack(gradients), torch.stack(curvatures))


def search_of(monkeypatch, minima, groups=None, symmetries=None):
    view = camera(32)
    task = task_of(torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0)), view)
    levels = [KnownMinima(task, minima, k == 2) for k in range(3)]
    monkeypatch.setattr(hypotheses, "pose_levels", lambda *_: levels)
    return HypothesisSearch(task, groups or [(START, turned(task, START))], [None], Settings(), symmetries)


T = 64.0  # pixels that count as one
MINIMA = [(-3000.0, RIGHT), (-2900.0, WRONG)]


@pytest.mark.quick
def test_the_likeliest_hypotheses_survive_and_lead_to_the_minima(monkeypatch):
    search = search_of(monkeypatch, [*MINIMA, (-1500.0, START)])
    modes = search.run()
    assert [mode.cost for mode in modes] == pytest.approx([-3000.0, -2900.0], abs=0.1)
    for mode, end in zip(modes, (RIGHT, WRONG), strict=True):
        assert search.apart(mode.pose, end) < 2e-2 and mode.rests
        assert torch.linalg.eigvalsh(mode.curvature).tolist() == pytest.approx(sorted(STIFF.tolist()), rel=0.02)
    assert torch.equal(search.likeliest.R, modes[0].pose.R) and search.cost == modes[0].cost
    again = search_of(monkeypatch, [*MINIMA, (-1500.0, START)]).run()
    assert [numbers(mode.pose) for mode in again] == [numbers(mode.pose) for mode in modes]


@pytest.mark.quick
def test_poses_that_a_symmetry_makes_equal_are_one_mode(monkeypatch):
    half = about_center(rotation(0.0, 0.0, math.pi))
    minima = [(-3000.0, RIGHT), (-3000.0, pose_from_matrix("init", RIGHT.matrix @ half))]
    # Hypotheses in two groups, each about its own pose.
    groups = [
        (end, [pose_from_matrix("init", about_center(rotation(0.0, 0.1, 0.0)) @ end.matrix)]) for _, end in minima
    ]
    symmetries = eg.Symmetries(half[None])
    for known, count in ((None, 2), (symmetries, 1)):
        search = search_of(monkeypatch, minima, groups, known)
        search.further = False
        assert len(search.run()) == count


def test_ctrl_c_keeps_the_likeliest_so_far(monkeypatch):
    for steps in (1, 6):
        search = search_of(monkeypatch, MINIMA)

        def after_step():
            if len(search.history) == steps:  # noqa: B023
                raise KeyboardInterrupt

        search.after_step = after_step
        with pytest.raises(KeyboardInterrupt):
            search.run()
        assert len(search.history) == steps
        costs = [step.loss for step in search.history]
        assert search.cost == min(costs) and costs == sorted(costs, reverse=True)
        best = [step.pose for step in search.history if step.best][-1]
        assert numbers(best) == numbers(search.likeliest)


@pytest.mark.quick
def test_further_hypotheses_lie_where_the_cost_rises_least(monkeypatch):
    search = search_of(monkeypatch, MINIMA)
    group = Group([KnownMinima(search.task, MINIMA, False)], [RIGHT], ReplayLog())
    group.enter(0, Settings())
    group.descents.advance()
    ends = group.open_ends(0)
    assert len(ends) == 2 * POSE.weak_directions
    places = torch.stack([group.level.place(end, RIGHT) for end in ends])
    assert float(places[:2].abs().argmax(1).unique()) == 5.0
    rise = 0.5 * places.square() @ STIFF
    torch.testing.assert_close(rise, torch.full_like(rise, 0.5 * (4.0 * POSE.weak_deviations) ** 2), rtol=0.02, atol=0)
    torch.testing.assert_close(places[0::2], -places[1::2], rtol=0.02, atol=1e-3)


@pytest.mark.quick
def test_probabilities_of_modes_are_ratios_of_gaussian_integrals():
    """The prior of a step is a normal one of variance 1. Numbers are of a grid."""
    x = torch.linspace(-6, 6, 1201, dtype=F64)
    grid = torch.cartesian_prod(x, x)
    modes, masses = [], []
    for cost, rows in ((-300.0, [[900.0, 100.0], [100.0, 300.0]]), (-250.0, [[90.0, 0.0], [0.0, 40.0]])):
        H = torch.tensor(rows, dtype=F64)
        modes.append(Mode(RIGHT, cost, H, True, KnownMinima(None, [], True), T))
        masses.append(float((-(cost + 0.5 * ((grid @ H) * grid).sum(1)) / T - 0.5 * grid.square().sum(1)).exp().sum()))
    found = probabilities(modes)
    assert found == pytest.approx([mass / sum(masses) for mass in masses], rel=1e-6)
    assert probabilities([]) == [] and probabilities(modes[:1]) == [1.0]


@pytest.mark.quick
def test_the_answer_is_the_mode_with_the_largest_mass(monkeypatch):
    """Of two minima the wider one has more mass, though it is less likely by 10 nats, of which 64 count as one."""
    modes = search_of(monkeypatch, [(-3000.0, RIGHT), (-2990.0, WRONG, 0.5)]).run()
    assert [mode.cost for mode in modes] == pytest.approx([-2990.0, -3000.0], abs=0.1)
    assert modes[0].log_mass - modes[1].log_mass == pytest.approx(3.0 * math.log(2.0) - 10.0 / T, abs=0.1)
    assert ambiguous(modes) == [modes[1].pose] and ambiguous(modes[:1]) == []


def test_the_same_seed_gives_the_same_modes():
    view = camera(24)
    task = task_of(photograph(view), view)

    def modes(seed):
        search = HypothesisSearch(task, [(START, [START])], [None], Settings(seed=seed, steps=2), further=False)
        return [numbers(mode.pose) for mode in search.run()]

    first = modes(1)
    assert first and modes(1) == first and modes(2) != first
