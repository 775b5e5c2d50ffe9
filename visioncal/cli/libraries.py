"""Libraries as commands need them: none loads what no command uses, and none before its use."""

import dataclasses
import sys
from collections import defaultdict
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import Loader
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec
from types import ModuleType
from typing import Any

# Parts that libraries import, and most commands do without.
_LATER = ("rerun.experimental",)


class SmallLibraries(Loader):
    """Keeps libraries small within its block, which save half the time of a short command.

    Arrow would import pandas, where installed, to check for arrays of it. SciPy parses and rewrites
    hundreds of docstrings as it is imported, and loads all parts of NumPy. Many modules import
    OpenCV for what few commands do. Dataclasses compile methods for every class as it is defined,
    of which a command calls a few.
    """

    def __init__(self) -> None:
        self._later = set(_LATER)

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Finds no pandas, and parts of libraries that are loaded when they are first used."""
        if fullname in self._later:
            self._later.remove(fullname)
            if spec := PathFinder.find_spec(fullname, path, target):
                spec.loader = self
            return spec
        if fullname == "pandas":
            raise ModuleNotFoundError("commands do without pandas", name=fullname)
        if fullname in {"scipy._lib._array_api", "scipy._lib._util"}:
            # Their decorators take the class from there.
            vars(import_module("scipy._lib._docscrape")).update(FunctionDoc=_Undocumented)
            numpy = vars(import_module("numpy"))
            for part in ("ctypeslib", "f2py", "ma", "polynomial", "random", "testing"):
                numpy.setdefault(part, _Postponed(f"numpy.{part}"))
        return None

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        """Makes a module that is loaded on first use."""
        return _Postponed(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Loads nothing yet."""

    def __enter__(self) -> None:
        sys.meta_path.insert(0, self)
        vars(dataclasses)["exec"] = _define_late
        if "cv2" not in sys.modules:
            sys.modules["cv2"] = _Postponed("cv2")

    def __exit__(self, *_: object) -> None:
        sys.meta_path.remove(self)
        vars(dataclasses).pop("exec", None)


def _define_late(text: str, scope: dict[str, Any], made: dict[str, Any]) -> None:
    """Takes the place of `exec` in `dataclasses`: methods of our classes are compiled when called.

    `text` defines a function `__create_fn__` of some names, which returns one method or a tuple.
    """
    returned = text.rpartition("\n return ")[2]
    names = [name for name in returned.strip("()").split(",") if name]
    if not str(scope.get("__name__")).startswith("visioncal.") or not all(
        name.startswith("__") and name.isidentifier() for name in names
    ):
        exec(text, scope, made)
        return

    def create(**local: object) -> object:
        compiled: dict[str, Any] = {}

        def late(name: str) -> Callable[..., object]:
            def method(self: object, *args: object, **kwargs: object) -> object:
                if not compiled:
                    namespace: dict[str, Any] = {}
                    exec(text, scope, namespace)
                    methods = namespace["__create_fn__"](**local)
                    methods = methods if "," in returned else [methods]
                    compiled.update(zip(names, methods, strict=True))
                compiled[name].__qualname__ = method.__qualname__
                for owner in type(self).__mro__:
                    if vars(owner).get(name) is method:
                        setattr(owner, name, compiled[name])
                return compiled[name](self, *args, **kwargs)

            method.__name__ = name
            return method

        methods = tuple(map(late, names))
        return methods if "," in returned else methods[0]

    made["__create_fn__"] = create


class _Undocumented(defaultdict[str, list[object]]):
    """A docstring without sections."""

    def __init__(self, *_: object, **__: object) -> None:
        super().__init__(list)

    def __str__(self) -> str:
        return "\n"


class _Postponed(ModuleType):
    """A module that is loaded when one of its attributes is first used."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__spec__ = find_spec(name)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - whatever the module has
        if part := sys.modules.get(f"{self.__name__}.{name}"):
            return part
        # Python itself looks for these as it imports.
        if name in {"__path__", "__file__", "__cached__"}:
            raise AttributeError(name)
        if sys.modules.get(self.__name__) is self:
            sys.modules.pop(self.__name__, None)
        # Another thread's import is waited for.
        module = import_module(self.__name__)
        self.__dict__.update({key: vars(module)[key] for key in vars(module) if key[:2] != "__"})
        return getattr(module, name)
