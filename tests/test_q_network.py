import math

import numpy as np
import pytest
from safetensors.torch import save_file
import torch

from rhp_drake.errors import InputError
from rhp_drake.random_streams import stream
from rhp_drake.task import NUM_ACTIONS, sample_instance
from rhp_drake.value.features import HAND_FEATURES, features, num_features
from rhp_drake.value.q_network import ARCHITECTURES, SetQNetwork
from rhp_drake.value.weights import load_q_network, save_q_network

PROVENANCE = {
    "command": "rhp reinforce",
    "seed": 3,
    "metrics": {"loss": 0.25, "sets": ["a"]},
}


@pytest.fixture(scope="module")
def scenes():
    """States (20, 12) and goals (20, 3, 2), in double precision."""
    instances = [sample_instance(stream(0, "test", i)) for i in range(20)]
    return (
        torch.from_numpy(np.stack([i.initial_state for i in instances])),
        torch.from_numpy(np.stack([i.goals for i in instances])),
    )


@pytest.fixture(params=ARCHITECTURES)
def network(request):
    torch.manual_seed(0)
    network = ARCHITECTURES[request.param](3)
    network.provenance = PROVENANCE
    return network


@pytest.fixture
def path(network, tmp_path):
    path = tmp_path / "weights.safetensors"
    save_q_network(network, path)
    return path


def moved(states, goals, angle, offset):
    """The scene rotated about W's origin and then shifted."""
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    shift = torch.tensor(offset, dtype=torch.float64)
    poses = states.unflatten(1, (-1, 3)).clone()
    poses[..., :2] = poses[..., :2] @ rotation.T + shift
    poses[..., 2] += angle
    return poses.flatten(1), goals @ rotation.T + shift


def test_values(network, scenes):
    states, goals = scenes
    values = network.values(states.numpy(), goals[0].numpy())
    assert values.shape == (20, NUM_ACTIONS)
    one = network.values(states[:1].numpy(), goals[0].numpy())
    np.testing.assert_allclose(one, values[:1], rtol=1e-5)


def test_round_trip(network, path, scenes):
    again = load_q_network(path, 3)
    assert again.provenance == PROVENANCE
    for key, tensor in network.state_dict().items():
        assert torch.equal(again.state_dict()[key], tensor)
    states, goals = (x.numpy() for x in scenes)
    np.testing.assert_array_equal(
        again.values(states, goals[0]), network.values(states, goals[0])
    )
    assert path.stat().st_size < 1e6


def message_of(path, num_objects=3) -> str:
    with pytest.raises(InputError) as info:
        load_q_network(path, num_objects)
    message = str(info.value)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    return message


def test_bad_files(path, tmp_path):
    assert "no such file" in message_of(tmp_path / "missing.safetensors")
    assert "not a readable file" in message_of(tmp_path)
    data = path.read_bytes()
    for broken in (b"", b"not weights", data[: len(data) // 2]):
        path.write_bytes(broken)
        assert "not a readable file" in message_of(path)
    save_file({"layers.0.weight": torch.zeros(2)}, path)
    assert "not the weights of a Q-network" in message_of(path)


def test_number_of_objects(network, path):
    if network.any_number:
        assert load_q_network(path, 2).num_objects == 2
    else:
        assert "are for 3 objects, not 2." in message_of(path, num_objects=2)


def test_unknown_architecture(path):
    metadata = {"format": "rhp_drake q_network 1", "architecture": "cubist"}
    save_file({"layers.0.weight": torch.zeros(2)}, path, metadata)
    assert "an unknown network, 'cubist'" in message_of(path)


def test_weights_of_wrong_shape(path):
    metadata = {"format": "rhp_drake q_network 1", "num_objects": "3"}
    save_file({"layers.0.weight": torch.zeros(2)}, path, metadata)
    assert "wrong shapes" in message_of(path)


@pytest.mark.parametrize(
    ("angle", "offset"), [(0.0, (0.1, -0.2)), (0.7, (0.0, 0.0)), (-2.5, (0.3, 0.1))]
)
def test_features_see_from_the_hand(scenes, angle, offset):
    expected = features(*scenes)
    assert expected.shape == (20, num_features(3))
    seen = features(*moved(*scenes, angle, offset))
    # Only the hand's own features know where the workspace is.
    torch.testing.assert_close(seen[:, HAND_FEATURES:], expected[:, HAND_FEATURES:])
    assert not torch.allclose(seen[:, :HAND_FEATURES], expected[:, :HAND_FEATURES])


def test_features_know_that_boxes_are_square(scenes):
    states, goals = scenes
    turned = states.clone()
    turned[:, 5] += math.pi / 2
    turned[:, 8] -= math.pi
    torch.testing.assert_close(features(turned, goals), features(states, goals))
    turned[:, 5] += 0.3
    assert not torch.allclose(features(turned, goals), features(states, goals))


def test_obstacles_are_a_set(scenes):
    """Their order does not matter, to the set network, nor their number."""
    torch.manual_seed(0)
    network = SetQNetwork(3)
    states, goals = (x.float() for x in scenes)
    expected = network(states, goals)
    order = [0, 2, 1]
    poses = states.unflatten(1, (-1, 3))
    swapped = torch.cat([poses[:, :1], poses[:, 1:][:, order]], dim=1).flatten(1)
    torch.testing.assert_close(network(swapped, goals[:, order]), expected)
    # The target is none of them.
    order = [1, 0, 2]
    swapped = torch.cat([poses[:, :1], poses[:, 1:][:, order]], dim=1).flatten(1)
    assert not torch.allclose(network(swapped, goals[:, order]), expected)
    for m in (1, 2, 3):
        assert network(states[:, : 3 + 3 * m], goals[:, :m]).shape == expected.shape


@pytest.mark.parametrize("m", [1, 2, 5])
def test_set_network_for_any_number_of_objects(m):
    torch.manual_seed(0)
    instance = sample_instance(stream(0, "test", m), m)
    values = SetQNetwork(m).values(instance.initial_state[None], instance.goals)
    assert np.isfinite(values).all()
