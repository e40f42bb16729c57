"""What makes tests of recordings quick."""

import functools

import pytest


@pytest.fixture(scope="package", autouse=True)
def compiled_once():
    """`rosbags` compiles its serializers for every recording that it opens: most of the time."""
    with pytest.MonkeyPatch.context() as patch:
        try:
            from rosbags.serde import cdr, ros1
        except ImportError:  # tests that need it are skipped
            yield
            return
        code = functools.cache(lambda text: compile(text, "<serializer>", "exec"))
        made = cdr.compile_lines

        def compile_lines(lines):
            module = made([])
            exec(code("\n".join(lines)), module.__dict__)
            return module

        for each in (cdr, ros1):
            patch.setattr(each, "compile_lines", compile_lines)
        yield
