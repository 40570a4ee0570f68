"""The order of learning against what it promises, and against a reckoning by hand of what each step needs."""

from __future__ import annotations

from collections import Counter
from itertools import islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mv3d_cli.steps.train.order import Order

ORDERS = st.builds(
    lambda objects, batch, reuse, seed: Order(objects, range(batch), batch, reuse, seed),
    st.integers(1, 40),
    st.integers(1, 7),
    st.integers(1, 9),
    st.integers(0, 1000),
)


def needed(order: Order, start: int, stop: int) -> list[int]:
    """Examples in the order of their first need in these steps, lane by lane, old ones first."""
    found: dict[int, None] = {}
    for step in range(start, stop):
        for lane in order.lanes:
            own = sorted(number for number in order.living(step) if number % order.total == lane)
            found |= dict.fromkeys(own)
    return [*found]


@given(ORDERS, st.integers(0, 5))
def test_every_object_once_an_epoch(order: Order, epoch: int) -> None:
    numbers = range(epoch * order.objects, (epoch + 1) * order.objects)
    assert sorted(order.object_of(number) for number in numbers) == [*range(order.objects)]


def test_epochs_and_seeds_have_orders_of_their_own() -> None:
    seeds = [Order(50, range(1), 1, 4, seed) for seed in range(3)]
    orders = {tuple(order.object_of(50 * epoch + i) for i in range(50)) for order in seeds for epoch in range(4)}
    assert len(orders) == 12


@given(ORDERS, st.integers(0, 60))
def test_what_is_chosen_lives(order: Order, step: int) -> None:
    living = order.living(step)
    for lane in order.lanes:
        assert order.chosen(lane, step) in living
        assert order.chosen(lane, step) % order.total == lane
    assert len(living) <= order.reuse * len(order.lanes)


@given(ORDERS, st.integers(0, 40))
def test_what_arrives_from_any_step_on_is_what_is_needed(order: Order, start: int) -> None:
    wanted = needed(order, start, start + 25)
    assert [*islice(order.arriving(start), len(wanted))] == wanted
    later = set(wanted) - set(needed(order, start, start + 10))
    from_zero = [*islice(order.arriving(0), len(needed(order, 0, start + 25)))]
    assert [number for number in from_zero if number in later] == [number for number in wanted if number in later]


@given(ORDERS)
def test_no_number_is_left_out(order: Order) -> None:
    """So that every object is seen once an epoch."""
    numbers = set().union(*(order.living(step) for step in range(8 * order.reuse)))
    assert set(range(6 * order.total)) <= numbers


@given(ORDERS, st.integers(0, 50))
def test_a_step_is_a_function_of_seed_lane_and_step(order: Order, step: int) -> None:
    again = Order(order.objects, order.lanes, order.total, order.reuse, order.seed)
    assert [again.chosen(lane, step) for lane in again.lanes] == [order.chosen(lane, step) for lane in order.lanes]


@pytest.mark.parametrize("reuse", [1, 3, 8])
def test_an_example_serves_about_as_often_as_asked(reuse: int) -> None:
    order, steps = Order(30, range(6), 6, reuse, 0), 2000
    served = Counter(order.chosen(lane, step) for step in range(steps) for lane in order.lanes)
    drawn = max(served) + 1
    assert sum(served.values()) / drawn == pytest.approx(reuse, rel=0.02)
    assert len(served) / drawn == pytest.approx(1 - (1 - 1 / reuse) ** reuse**2, abs=0.02)  # few are never chosen
    assert np.std([served[number] for number in range(6 * reuse, drawn)]) < np.sqrt(reuse)
    assert (reuse == 1) == (max(served.values()) == 1)


def test_lanes_take_turns() -> None:
    """In every step as many examples are drawn, rather than all at once every so often."""
    order = Order(100, range(16), 16, 4, 0)
    drawn = [len(order.living(step) - order.living(step - 1)) for step in range(10, 30)]
    assert set(drawn) == {4}


@given(ORDERS, st.integers(2, 4), st.integers(0, 30))
def test_several_processes_are_one_with_a_larger_batch(one: Order, processes: int, step: int) -> None:
    here = len(one.lanes)
    whole = Order(one.objects, range(processes * here), processes * here, one.reuse, one.seed)
    parts = [
        Order(one.objects, range(rank * here, (rank + 1) * here), processes * here, one.reuse, one.seed)
        for rank in range(processes)
    ]
    chosen = [part.chosen(lane, step) for part in parts for lane in part.lanes]
    assert chosen == [whole.chosen(lane, step) for lane in whole.lanes]
    assert set().union(*(part.living(step) for part in parts)) == whole.living(step)
    assert sum(len(part.living(step)) for part in parts) == len(whole.living(step))
