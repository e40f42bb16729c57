"""The cache holds the values used last, as a plain list of them would, and no more bytes."""

from hypothesis import given
from hypothesis import strategies as st

from orthonav.core.mapfile.reader import ByteCache

KEYS = "abcdef"
STEPS = st.lists(st.tuples(st.sampled_from(["get", "put"]), st.sampled_from(KEYS)), max_size=60)


@given(limit=st.integers(0, 12), steps=STEPS)
def test_the_values_used_last_are_held(limit, steps):
    sizes = {key: size for size, key in enumerate(KEYS, start=1)}
    cache, held = ByteCache(limit, len), []
    for step, key in steps:
        there = key in held
        if step == "get":
            assert cache.get(key) == ("x" * sizes[key] if there else None)
            if there:
                held.append(held.pop(held.index(key)))
            continue
        cache.put(key, "x" * sizes[key])
        if not there:
            held.append(key)
        while sum(map(sizes.get, held)) > limit:
            held.pop(0)
        assert cache.held_bytes == sum(map(sizes.get, held)) <= limit


def test_the_first_value_of_a_key_stays():
    cache = ByteCache(10, len)
    cache.put("a", b"one")
    cache.put("a", b"longer")
    assert cache.get("a") == b"one" and cache.held_bytes == 3
