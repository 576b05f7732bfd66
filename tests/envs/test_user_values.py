"""Values from a user's environment are converted if their meaning is clear, else rejected."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
import torch

from merl.core import EnvironmentFailed
from merl.envs.user_values import to_array, to_bool, to_info, to_number

# fmt: off
TRUE = (
    True, 1, 1.0, np.bool_(True), np.int64(1), np.float32(1), np.ones(1), np.array(True), [True],
    np.ones((1, 1), np.uint8), torch.tensor(True), torch.tensor([1.0], requires_grad=True),
)
FALSE = (
    False, 0, 0.0, -0.0, np.bool_(False), np.int8(0), np.zeros(1), [False], [[0]],
    torch.tensor(False),
)
NEITHER = (
    None, np.nan, "False", "True", "", b"", 0.3, 2, -1, np.inf, [True, False], [], np.zeros(0),
    np.array("False"), {"other": True}, {}, {"task": None}, {"task": {"task": True}},
    {"task": "False"}, {"task": np.nan}, ..., 1 + 0j, {True},
)
# fmt: on


@pytest.mark.parametrize("key", ["success", "is_success"])
def test_common_forms_of_success_become_true_or_false(key: str) -> None:
    for values, expected in ((TRUE, True), (FALSE, False)):
        for value in values:
            for form in (value, {"task": value}, {"task": value, "grasp": "?"}):
                assert to_info({key: form})["success"] is expected, value


@pytest.mark.parametrize("key", ["success", "is_success"])
@pytest.mark.parametrize("value", NEITHER, ids=str)
def test_other_forms_of_success_are_rejected_in_one_line(key: str, value: Any) -> None:
    with pytest.raises(EnvironmentFailed) as caught:
        to_info({key: value})
    assert f'info["{key}"]' in str(caught.value)
    inner = value.get("task", value) if isinstance(value, dict) else value
    assert repr(inner)[:20] in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_success_takes_precedence_over_is_success_and_is_optional() -> None:
    assert to_info({"success": 0, "is_success": True})["success"] is False
    assert "success" not in to_info({"lap": 3})


@pytest.mark.parametrize("value", ["False", np.nan, None, 0.5, [True, False], {"task": True}, 2])
def test_terminated_must_be_true_or_false(value: Any) -> None:
    with pytest.raises(EnvironmentFailed, match=r"terminated is .*: it must be true or false"):
        to_bool("terminated", value)
    assert to_bool("terminated", np.array([1])) is True


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (None, "reward is None: it must be a number"),
        ("1.5", "reward is '1.5': it must be a number"),
        ([0.5, 0.5], r"reward is \[0.5, 0.5\], 2 values: .* their weighted sum"),
        (np.zeros(0), "0 values"),
        (np.arange(10_000.0), "10000 values"),
        ({"a": 1.0}, "it must be a number"),
        (1j, "it must be a number"),
    ],
)
def test_a_reward_must_be_one_number(value: Any, message: str) -> None:
    with pytest.raises(EnvironmentFailed, match=message) as caught:
        to_number("reward", value)
    assert len(str(caught.value)) < 250
    assert len(str(caught.value).splitlines()) == 1


def test_masked_values_are_rejected() -> None:
    with pytest.raises(EnvironmentFailed, match="'arm' has masked values: fill them"):
        to_array("observation 'arm'", np.ma.masked_array([0.0, 999.0], mask=[0, 1]))
    assert to_array("x", np.ma.masked_array([0.0, 1.0], mask=[0, 0])).tolist() == [0.0, 1.0]


def test_numbers_in_an_object_array_are_converted() -> None:
    assert to_array("x", np.array([0.5, 1], object)).tolist() == [0.5, 1.0]


def test_a_reward_may_be_an_array_of_one_or_a_tensor() -> None:
    for value in (2, np.float32(2), [2.0], np.full((1, 1), 2), torch.tensor(2.0).requires_grad_()):
        assert to_number("reward", value) == 2.0
    assert np.isnan(to_number("reward", np.nan))  # the run's guard reports it, with the step


class UnreadableValue:
    """A value that raises on conversion and on repr."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("the device is busy\nfor a while")

    def __repr__(self) -> str:
        raise RuntimeError


@pytest.mark.parametrize(
    "value",
    [
        [[1.0], [1.0, 2.0]],
        [np.zeros(2), np.zeros(3)],
        None,
        [1.0, None],
        ["1", "2"],
        ...,
        {"a": 1.0},
        [1j],
        np.array(["2020-01-01"], "datetime64[D]"),
        torch.zeros(2, device="meta"),
        torch.eye(2).to_sparse(),
        [torch.zeros(2), torch.zeros(3)],
        UnreadableValue(),
    ],
    ids=lambda value: type(value).__name__,
)
def test_observations_that_are_not_numbers_are_rejected_by_name(value: Any) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(EnvironmentFailed, match="observation 'arm'") as caught:
            to_array("observation 'arm'", value)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 400


def test_tensors_are_detached_and_copied_to_the_host() -> None:
    for tensor in (
        torch.ones(2, requires_grad=True),
        torch.ones(2, dtype=torch.bfloat16, requires_grad=True),
        torch.ones(2, dtype=torch.float64),
        [torch.tensor(1.0, requires_grad=True), torch.tensor(1.0)],
        (torch.ones(1, requires_grad=True).sum(), 1.0),
    ):
        np.testing.assert_array_equal(to_array("x", tensor), [1.0, 1.0])


class DeviceTensor:
    """Like a tensor on a GPU: NumPy cannot read it before it is detached and copied."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")

    def detach(self) -> DeviceTensor:
        self.is_detached = True
        return self

    def cpu(self) -> Any:
        assert self.is_detached
        return torch.ones(3)


def test_tensors_on_a_device_are_copied_to_the_host() -> None:
    np.testing.assert_array_equal(to_array("x", DeviceTensor()), np.ones(3))


@pytest.mark.parametrize("name", ["a\nb", "a\rb", "\x1b[31m"])
def test_a_reward_term_needs_a_name_for_a_column(name: str) -> None:
    with pytest.raises(EnvironmentFailed, match="cannot be printed in its name") as caught:
        to_info({"reward_terms": {"near": 1.0, name: 0.5}})
    assert str(caught.value).isprintable()
    assert to_info({"reward_terms": {'näher, "x"': 0.5}})["reward_terms"]
