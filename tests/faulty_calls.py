"""Errors raised by one call after the other of a function, as they stand in its source."""

import ast
import inspect
import textwrap


class FaultyCalls:
    """A function whose calls raise an error, one at a time; `made`: those that a run makes."""

    def __init__(self, monkeypatch, owner, name):
        self.made, self._armed, self._texts = [], None, []
        self.raised = lambda: None
        whole = getattr(owner, name)
        (function,) = ast.parse(textwrap.dedent(inspect.getsource(whole))).body
        function.body = [_Guarded(self._texts).visit(each) for each in function.body]
        future = ast.parse("from __future__ import annotations").body
        module = ast.fix_missing_locations(ast.Module([*future, function], []))
        names = {**whole.__globals__, "_reach": self._reach}
        exec(compile(module, f"<calls of {name}>", "exec"), names)
        monkeypatch.setattr(owner, name, names[whole.__name__])

    def each(self, run):
        """Texts of the calls and results of `run`, in which the first such call raises an error."""
        run()
        for number in sorted(set(self.made)):
            self._armed = number
            yield self._texts[number], run()
            assert self._armed is None, f"not reached again: {self._texts[number]}"

    def _reach(self, number):
        self.made.append(number)
        if self._armed == number:
            self._armed = None
            self.raised()
            raise ValueError("odd")


class _Guarded(ast.NodeTransformer):
    """`f(x)` becomes `_reach(number) or f(x)`."""

    def __init__(self, texts):
        self._texts = texts

    def visit_Call(self, node):
        self._texts.append(ast.unparse(node))
        reach = ast.parse(f"_reach({len(self._texts) - 1})", mode="eval").body
        return ast.BoolOp(ast.Or(), [reach, self.generic_visit(node)])
