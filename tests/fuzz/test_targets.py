"""The fuzzer's targets take their seeds, and what a few wrong bytes make of these."""

import random

import pytest

from tests.fuzz.targets import TARGETS


@pytest.mark.parametrize("name", TARGETS)
def test_seeds_and_spoiled_seeds_are_taken(name):
    target, dice = TARGETS[name], random.Random(1)
    assert len(target.words()) > 1
    for seed in target.seeds():
        target.take(seed)
        for _ in range(5):
            data = bytearray(seed)
            for _ in range(dice.randint(1, 4)):
                data[dice.randrange(len(data))] = dice.randrange(256)
            target.take(bytes(data[: dice.randint(len(data) // 2, len(data))]))
