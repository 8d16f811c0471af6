import numpy as np

from rejoint.arms import dls, mycobot280, position_kinematics, tcp_position
from rejoint.control.controllers.feedforward import Commander, CommandLaw
from rejoint.control.controllers.observation import Observer, layout_slots, look
from standin import inputs_of, state_of

ARM = mycobot280()


def inputs(position, target, sent, time=0.0, since=0.0):
    count = len(position)
    state = state_of(np.asarray(position), time)
    return inputs_of(state, np.asarray(target), np.tile(ARM.rest, (count, 1)), np.asarray(sent), since)


def columns(layout):
    result, start = {}, 0
    for slot in layout_slots(layout, ARM.joints):
        result[slot.name] = slice(start, start + slot.size)
        start += slot.size
    return result


def random_inputs(rng, count, time):
    position = ARM.rest + rng.normal(0.0, 0.2, (count, 6))
    return inputs(position, ARM.targets.sample(rng, (count,)), position + rng.normal(0.0, 0.05, (count, 6)), time)


def test_residual_observation_worked_by_hand():
    where = columns("residual")
    first, second = ARM.rest.copy(), ARM.rest.copy()
    second[1] += 0.01
    acted = np.array([[0.1, 0.2, 0.3, 0.4, 0.5, 0.6]])
    target = tcp_position(ARM, second) + np.array([0.003, -0.004, 0.012])  # 13 mm away
    sent = second + np.array([0.1, -0.2, 0.0, 0.0, 0.05, 0.0])
    observer = Observer(ARM, 1)
    begin = inputs([first], [target], [sent], time=1.0)
    observer.reset(begin, np.array([True]))
    observer.observe(begin)
    observer.acted(-acted)
    observer.observe(inputs([first - 0.002], [target], [sent], time=1.2, since=0.275))
    observer.acted(acted)
    seen = observer.observe(inputs([second], [target], [sent], time=1.225, since=0.3))[0]
    tcp, jacobian = position_kinematics(ARM, second)
    step = dls(jacobian, target - tcp)
    expected = {
        "drive": [0.4, -0.8, 0.0, 0.0, 0.2, 0.0],
        "velocity": [0.04, 0.04 + 0.2, 0.04, 0.04, 0.04, 0.04, *[-0.005] * 6, *[0.0] * 6],
        "step": 5.0 * step,
        "step.near": np.tanh(step / np.radians(1.0)),
        "step.fine": np.tanh(step / np.radians(0.2)),
        "position": second,
        "error": [0.06, -0.08, 0.24],
        "direction": np.array([0.003, -0.004, 0.012]) / 0.016,
        "distance": [(np.log(0.0133) + 5.0) / 2.0],
        "waited": [-0.2],
        "period": [20.0 * (0.3 * 0.025 + 0.7 * (0.3 * 0.1 + 0.7 * 0.035)) - 0.7],  # a gap counts as 0.1 s,
        "action": [*acted[0], *-acted[0], *np.zeros(6)],
    }
    assert set(expected) == set(where)
    for name, values in expected.items():
        np.testing.assert_allclose(seen[where[name]], values, rtol=2e-6, atol=2e-7, err_msg=name)


def test_equation_16_worked_by_hand():
    where = columns("equation-16")
    target = tcp_position(ARM, ARM.rest) + np.array([0.0, 0.0, 0.004])
    observer = Observer(ARM, 1, "equation-16")
    now = inputs([ARM.rest], [target], [ARM.rest + 0.02], since=7.0)
    observer.reset(now, np.array([True]))
    seen = observer.observe(now)[0]
    assert seen[where["time"]] == 2.0
    np.testing.assert_allclose(seen[where["drive"]], 0.08, rtol=1e-6)
    np.testing.assert_allclose(seen[where["tcp"]], 5.0 * tcp_position(ARM, ARM.rest), rtol=1e-6)
    np.testing.assert_allclose(seen[where["target"]], 5.0 * target, rtol=1e-6)
    np.testing.assert_allclose(seen[where["distance"]], 0.02, rtol=1e-5)
    assert seen[where["success"]] == 1.0
    assert seen[where["collision"]] == 0.0


def test_a_batch_sees_what_single_arms_see():
    rng = np.random.default_rng(3)
    batch, singles = Observer(ARM, 7), [Observer(ARM, 1) for _ in range(7)]
    for cycle in range(3):
        now = random_inputs(rng, 7, time=0.02 * cycle)
        parts = [
            inputs(now.state.position[i : i + 1], now.target[i : i + 1], now.sent[i : i + 1], 0.02 * cycle)
            for i in range(7)
        ]
        if cycle == 0:
            batch.reset(now, np.ones(7, dtype=bool))
            for observer, part in zip(singles, parts, strict=True):
                observer.reset(part, np.array([True]))
        action = rng.uniform(-1.0, 1.0, (7, 6))
        alone = np.concatenate([o.observe(part) for o, part in zip(singles, parts, strict=True)])
        np.testing.assert_array_equal(batch.observe(now), alone)
        batch.acted(action)
        for i, observer in enumerate(singles):
            observer.acted(action[i : i + 1])


def test_a_repeated_answer_keeps_the_velocity():
    observer = Observer(ARM, 1)
    target = ARM.targets.lower[None]
    start = inputs([ARM.rest], target, [ARM.rest], time=0.0)
    observer.reset(start, np.array([True]))
    moved = inputs([ARM.rest + 0.01], target, [ARM.rest], time=0.02)
    where = columns("residual")
    first = observer.observe(moved)[0]
    np.testing.assert_allclose(first[where["velocity"]], 6 * [0.25] + 12 * [0.0], rtol=1e-5)
    np.testing.assert_array_equal(observer.observe(moved)[0], first)


def test_reset_forgets_only_the_arms_named():
    observer = Observer(ARM, 2)
    target, sent = np.tile(ARM.targets.lower, (2, 1)), np.tile(ARM.rest, (2, 1))
    observer.reset(inputs(sent, target, sent), np.ones(2, dtype=bool))
    observer.acted(np.full((2, 6), 0.5))
    now = inputs(sent + 0.01, target, sent, time=0.02)
    observer.reset(now, np.array([True, False]))
    seen, where = observer.observe(now), columns("residual")
    assert (seen[0, where["action"]] == 0.0).all()
    assert (seen[0, where["velocity"]] == 0.0).all()
    np.testing.assert_array_equal(seen[1, where["action"]], 6 * [0.5] + 12 * [0.0])
    assert (seen[1, where["velocity"]][:6] > 0.2).all()


def test_the_homing_motion_leaves_the_tool_in_place_to_first_order():
    rng = np.random.default_rng(5)
    position = ARM.rest + rng.normal(0.0, 0.3, (20, 6))
    view = look(ARM, position, tcp_position(ARM, position), np.tile(ARM.rest, (20, 1)))
    jacobian = position_kinematics(ARM, position)[1]
    drift = np.linalg.norm((jacobian @ view.homing[..., None])[..., 0], axis=-1)
    straight = np.linalg.norm((jacobian @ (ARM.rest - position)[..., None])[..., 0], axis=-1)
    assert (drift < 0.3 * straight).all()  # damping lets a little through
    assert (np.einsum("bi,bi->b", view.homing, ARM.rest - position) > 0.0).all()


def commanded(law, view, position, action):
    return Commander(ARM, law).commands(inputs(position, position[:, :3], position), view, action)


def test_command_law_worked_by_hand():
    law = CommandLaw(authority_floor=float(np.radians(0.12)))
    position = ARM.rest[None]
    view = look(ARM, position, tcp_position(ARM, position), position)._replace(
        step=np.radians([[2.0, 0, 0, 0, 0, -1.0]])
    )
    action = np.array([[1.0, -1.0, 0.5, 0.0, 5.0, 0.0]])
    command = commanded(law, view, position, action)
    expected = np.array([[0.2 + 1.12, -1.12, 0.56, 0.0, 1.12, -0.1]])
    np.testing.assert_allclose(np.degrees(command - position), expected)


def test_command_law_bounds_step_lead_and_joint_limits():
    rng = np.random.default_rng(6)
    law = CommandLaw(step_gain=5.0)
    position = rng.uniform(ARM.lower, ARM.upper, (200, 6))
    view = look(ARM, position, ARM.targets.sample(rng, (200,)), position)
    command = commanded(law, view, position, rng.uniform(-3.0, 3.0, (200, 6)))
    assert (np.abs(command - position) <= law.lead_limit + 1e-12).all()
    assert ((command >= ARM.lower) & (command <= ARM.upper)).all()
