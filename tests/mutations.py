"""Mutations of valid input: messages, records with other contents, text files with other values."""

from __future__ import annotations

import random
import re

Chance = random.Random

SPECIAL_BYTES = (0x00, 0x7F, 0x80, 0x81, 0x90, 0x91, 0xC0, 0xC1, 0xC4, 0xC7, 0xCA, 0xCB, 0xCF, 0xD9, 0xDD, 0xDF, 0xFF)
SPECIAL_VALUES = (
    *(None, True, False, 0, -1, 1, 2**31, 2**63 - 1, -(2**63), 2**64 - 1, 0.0, -0.0, 1e-320, 1e308, -1e308),
    *(float("nan"), float("inf"), "", "x", "\0", "é" * 40, "x" * 900, [], [[]], {}, {"": []}, [0.0] * 9, [1e300] * 4),
)
SPECIAL_TOKENS = (
    *("nan", "inf", "-inf", "1e400", "-1", "0", "1.5", "99999999999999999999", "true", '""', "''", "[]", "[[]]", "{}"),
    *(
        '"../../etc/passwd"',
        '"\\u0000"',
        '"$(id)"',
        '"__import__"',
        "1979-05-27T07:32:00Z",
        "0x7f",
        '"x" = 1',
        "= =",
        "#",
    ),
)
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:[eE][+-]?\d+)?")
SPECIAL_NUMBERS = (
    *(
        "nan",
        "-nan",
        "inf",
        "-inf",
        "1e308",
        "-1e308",
        "1e400",
        "1e-320",
        "-0",
        "0",
        "-1",
        "1e9",
        "1e19",
        "181",
        "90.1",
    ),
    *(
        "9" * 20,
        "9" * 400,
        "1_0",
        "0x1",
        "1e",
        "1,5",
        "",
        "1.7976931348623157e308",
        "2147483648",
        "-9223372036854775809",
    ),
)


def mutated(chance: Chance, good: bytes, donor: bytes) -> bytes:
    """Flips, removes, repeats and inserts bytes; sometimes returns noise or a truncation."""
    kind = chance.randrange(20)
    if kind == 0:
        return chance.randbytes(chance.randrange(300))
    if kind == 1:
        return good[: chance.randrange(len(good))]
    data = bytearray(good)
    for _ in range(chance.randint(1, 4)):
        place, length = chance.randrange(len(data) + 1), chance.randint(0, 12)
        change = chance.randrange(6)
        if change == 0 and place < len(data):
            data[place] = chance.randrange(256)
        elif change == 1 and place < len(data):
            data[place] = chance.choice(SPECIAL_BYTES)
        elif change == 2 and place < len(data):
            data[place] ^= 1 << chance.randrange(8)
        elif change == 3:
            del data[place : place + length]
        else:
            start = chance.randrange(len(donor))
            data[place : place + (length if change == 4 else 0)] = donor[start : start + length]
    return bytes(data)


def with_other_fields(chance: Chance, plain: object) -> object:
    """Replaces one value of nested plain data."""
    if isinstance(plain, dict) and plain and chance.random() < 0.8:
        key = chance.choice(sorted(plain))
        if chance.random() < 0.1:
            return {k: v for k, v in plain.items() if k != key}
        return {**plain, key: with_other_fields(chance, plain[key])}
    if isinstance(plain, list) and plain and chance.random() < 0.8:
        place = chance.randrange(len(plain))
        return [*plain[:place], with_other_fields(chance, plain[place]), *plain[place + 1 :]]
    return chance.choice(SPECIAL_VALUES)


def mutated_text(chance: Chance, good: str) -> bytes:
    """A text file with other and swapped numbers, or foreign bytes, or lost, doubled and foreign lines and values."""
    kind = chance.random()
    if kind < 0.3:
        return mutated(chance, good.encode(), good.encode())
    if kind < 0.6:
        return with_other_numbers(chance, good).encode()
    lines = good.splitlines()
    for _ in range(chance.randint(1, 3)):
        place = chance.randrange(len(lines))
        key, equals, _ = lines[place].partition("=")
        change = chance.randrange(6)
        if change <= 2 and equals:
            lines[place] = f"{key}= {chance.choice(SPECIAL_TOKENS)}"
        elif change == 3:
            lines[place] = lines[place][::-1] if chance.random() < 0.2 else ""
        elif change == 4:
            lines.insert(place, chance.choice(lines))
        else:
            lines.insert(
                place, f"{chance.choice(('x', 'every', 'camera', 'vehicle'))} = {chance.choice(SPECIAL_TOKENS)}"
            )
    return "\n".join(lines).encode()


def with_other_numbers(chance: Chance, good: str) -> str:
    """Replaces some numbers of a text by special ones, or by other numbers of the text."""
    numbers = list(NUMBER.finditer(good))
    for found in sorted(chance.sample(numbers, min(len(numbers), chance.randint(1, 3))), key=lambda one: -one.start()):
        other = chance.choice(SPECIAL_NUMBERS) if chance.random() < 0.7 else chance.choice(numbers)[0]
        good = good[: found.start()] + other + good[found.end() :]
    return good
