"""Neighbours of a class: classes whose names share a noun with its name, so that they may be near-synonyms.

Class names are all we know. They show that a lampshade belongs to a lamp, not that a desk is a table.
"""

import re
from collections.abc import Collection, Iterator, Sequence
from typing import Final, NamedTuple

WORD: Final = re.compile(r"[^\W\d_]{2,}")
ASIDE: Final = re.compile(r"\(.*?\)|'s\b")
"""Remarks in brackets, and the ending of a possessive."""

PLURAL: Final = re.compile(r"(?:(?<=ss)|(?<=sh)|(?<=ch)|(?<=x))es$|(?<![sui])s$")
SMALL: Final = frozenset({"and", "or", "the", "an"})
PREPOSITIONS: Final = frozenset({"of", "for", "with", "in", "on", "at", "to", "from"})
"""A noun stands before them: cup of tea."""

SHORTEST: Final = 3
"""Letters of a part of a compound at least."""


class _Nouns(NamedTuple):
    """Of one class: the last words of its synonyms, and all words."""

    heads: frozenset[str]
    words: frozenset[str]


def neighbours(labels: Collection[int], classes: Sequence[str]) -> frozenset[int]:
    """The classes, other than ``labels``, whose names share a noun with that of one of ``labels``.

    A name is a list of synonyms ("lampshade, lamp shade"); the last word of each is its noun. A noun of the one name
    must occur anywhere in the other: table lamp and lamp shade, laptop computer and notebook computer, but not tennis
    ball and tennis racket. A compound of two words of the classifier's names counts as both: basketball is a ball.
    """
    spoken = [list(_synonyms(name)) for name in classes]
    known = {word for synonyms in spoken for synonym in synonyms for word in synonym}
    nouns = [_nouns(synonyms, known) for synonyms in spoken]
    heads = frozenset().union(*(nouns[label].heads for label in labels))
    words = frozenset().union(*(nouns[label].words for label in labels))
    near = (index for index, each in enumerate(nouns) if heads & each.words or words & each.heads)
    return frozenset(near) - frozenset(labels)


def _synonyms(name: str) -> Iterator[list[str]]:
    """The words of each synonym, in the singular."""
    for synonym in ASIDE.sub(" ", name.casefold()).split(","):
        words = [PLURAL.sub("", word) for word in WORD.findall(synonym) if word not in SMALL]
        if words:
            yield words


def _nouns(synonyms: Sequence[Sequence[str]], known: Collection[str]) -> _Nouns:
    heads, words = set[str](), set[str]()
    for synonym in synonyms:
        end = next((k for k, word in enumerate(synonym) if k and word in PREPOSITIONS), len(synonym))
        heads |= {synonym[end - 1], _parts(synonym[end - 1], known)[-1]}
        words.update(*({word, *_parts(word, known)} for word in synonym if word not in PREPOSITIONS))
    return _Nouns(frozenset(heads), frozenset(words))


def _parts(word: str, known: Collection[str]) -> tuple[str, ...]:
    """The two ``known`` words that a compound consists of, otherwise the word itself."""
    cuts = range(SHORTEST, len(word) - SHORTEST + 1)
    return next(((word[:cut], word[cut:]) for cut in cuts if word[:cut] in known and word[cut:] in known), (word,))
