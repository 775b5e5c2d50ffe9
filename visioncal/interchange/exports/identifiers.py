"""Names in the controllers' languages, which are stricter than ours."""

import re
from dataclasses import dataclass

from visioncal.core.errors import DataError


@dataclass(frozen=True)
class Language:
    """What a language takes for the name of a variable.

    Attributes:
        name: The language's name.
        shape: What a name looks like.
        needed: The same in words.
        taken: Names that it keeps for itself; in small letters where capitals are alike.
        cased: Whether it distinguishes capitals from small letters.
    """

    name: str
    shape: re.Pattern[str]
    needed: str
    taken: frozenset[str]
    cased: bool


_RAPID_WORDS = """
    tool0 wobj0 load0
    alias and backward case connect const default div do else elseif endfor endfunc endif endmodule
    endproc endrecord endtest endtrap endwhile error exit false for from func goto if inout local
    mod module nostepin not noview or pers proc raise readonly record retry return step sysmodule
    task test then to trap true trynext undo var viewonly while with xor
"""
_URSCRIPT_WORDS = """
    and break continue def elif else end enter_critical exit_critical False global halt if in join
    kill local not or pause return run sec struct thread True while xor
"""

# ABB, "RAPID kernel", lexical elements: identifiers of up to 32 characters, capitals alike, and the
# reserved words. tool0, wobj0 and load0 are the system's own and cannot be changed.
RAPID = Language(
    "RAPID",
    re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}", re.ASCII),
    "a letter first, then letters, digits and _, 32 in all",
    frozenset(_RAPID_WORDS.split()),
    cased=False,
)

# Universal Robots, script manual, "Numbers, Variables, and Types", "Flow of Control", "Threads" and
# "Secondary Programs": the words that these are written with.
URSCRIPT = Language(
    "URScript",
    re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII),
    "a letter or _ first, then letters, digits and _",
    frozenset(_URSCRIPT_WORDS.split()),
    cased=True,
)


def check_identifier(name: str, language: Language) -> str:
    """Gives back a name that the language takes for a variable's.

    Raises:
        DataError: It does not.
    """
    compared = name if language.cased else name.lower()
    if not language.shape.fullmatch(name):
        wrong = f"{language.needed}, are needed"
    elif compared in language.taken:
        wrong = "it is the language's own"
    else:
        return name
    raise DataError(
        f"{name!r} cannot be a name in {language.name}: {wrong}.",
        culprits=[name],
        next_step="Choose another with --child.",
    )
