"""The nearest of the words that would have been right. A module of its own: `tools/dtsa` reads it before a set-up."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable


def hint(word: str, words: Iterable[str]) -> str:
    """A question that names the nearest word, as the end of an error; empty if none is near.

    :param word: what was written.
    :param words: what could have been meant.
    """
    found = difflib.get_close_matches(word, list(words), n=1, cutoff=0.6)
    return f"; did you mean {found[0]}?" if found and found[0] != word else ""


def words_of(allowed: str) -> list[str]:
    """The single words in a list such as ``tdma, dtsa or age``; what is prose is left out.

    :param allowed: what an error says would have been allowed.
    """
    parts = re.split(r"\s*[,;]\s*|\s+or\s+", allowed)
    return [part for part in parts if re.fullmatch(r"[A-Za-z][\w.-]*", part)]
