"""Errors that a user meets: each is one clear line, what is wrong, where, and what would be right."""

from __future__ import annotations


class F2SError(Exception):
    """Base of all errors that end a run with one line and no traceback.

    ``exit_code`` is what the command returns to the shell.
    """

    exit_code = 1


class InputError(F2SError):
    """Wrong input: file, key or row, what is wrong with it and what would be right."""

    exit_code = 2


class TooManyRanks(InputError):
    """A box that is too small to be shared by the ranks of this run."""


class CheckpointError(F2SError):
    """A checkpoint that is missing, damaged, or does not belong to this scene."""

    exit_code = 3


class UnstableStep(F2SError):
    """The numerics left the finite world (NaN, collapse of the time step); names the cell."""

    exit_code = 4
