# SPDX-FileCopyrightText: 2026 surfel_mapper contributors
# SPDX-License-Identifier: Apache-2.0
"""
Parser of the command line, which names the nearest option or verb for a misspelt one.

Misspelt options are refused before anything else. Otherwise argparse would take their values for
further arguments, or state that a required option is missing. An abbreviation that fits one option
only is that option, as argparse has it. One that fits several is an error that lists them.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from itertools import takewhile
import re
from typing import Any, NoReturn

from surfel_mapper.errors import one_line


class Parser(argparse.ArgumentParser):
    """Parser that names the nearest option or verb for one that does not exist."""

    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments; exit with 2 for misspelt options."""
        if args is not None and (misspelt := list(self.unknown_options(args))):
            self.error('; '.join(map(self.no_option, misspelt)))
        return super().parse_known_args(args, namespace)

    def unknown_options(self, words: Iterable[str]) -> Iterable[str]:
        """Yield the words in front of ``--`` and of a verb that are no options but look so."""
        has_verbs = any(isinstance(a, argparse._SubParsersAction) for a in self._actions)
        for word in takewhile(lambda word: word != '--', words):
            if looks_like_option(word):
                name = word.partition('=')[0]
                if not self.is_option(name):
                    yield name
            elif has_verbs:  # the words after a verb are those of its parser
                return

    def is_option(self, name: str) -> bool:
        """Return whether there is an option of a name, or one that it abbreviates."""
        options = self._option_string_actions
        if name in options:
            return True
        if name.startswith('--'):
            return any(option.startswith(name) for option in options)
        return name[:2] in options and f'-{name}' not in options

    def no_option(self, name: str) -> str:
        """Return a sentence about an option that does not exist, with the nearest one."""
        return f'no option {name}{nearest(name, list(self._option_string_actions))}'

    def error(self, message: str) -> NoReturn:
        """Print usage and message, with the nearest known words, and exit with 2."""
        choice = re.match(r"argument VERB: invalid choice: '([^']*)'", message)
        if choice:
            actions = (a for a in self._actions if isinstance(a, argparse._SubParsersAction))
            verbs = [verb for action in actions for verb in action.choices]
            message = (
                f'no verb {choice[1]!r}{nearest(choice[1], verbs) or ";"} '
                f'verbs: {", ".join(verbs)}'
            )
        choice = re.search(r": invalid choice: '([^']*)' \(choose from (.*)\)$", message)
        if choice:
            message += nearest(choice[1], re.findall(r"[^', ]+", choice[2]))
        super().error(one_line(message))


def looks_like_option(word: str) -> bool:
    """Return whether argparse takes a word for an option: not for a number or for words."""
    if not word.startswith('-') or word == '-' or ' ' in word:
        return False
    try:
        float(word)
    except ValueError:
        return True
    return False


def nearest(word: str, choices: list[str]) -> str:
    """Return a question with the nearest of some words; empty if none is near."""
    bare = {choice.lstrip('-'): choice for choice in choices}  # dashes alone would look alike
    close = get_close_matches(word.lstrip('-'), bare, n=1)
    return f', did you mean {bare[close[0]]}?' if close else ''
