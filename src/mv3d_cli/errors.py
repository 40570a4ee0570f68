"""Every error a user can meet: one line that says what is wrong, one hint that says what to do.

Mv3dError                    the root; `str(error)` is the line, `error.hint` the advice
|- InputError       exit 2   what the user gave cannot be used
|  |- UsageError             a command line that does not parse, or a setting out of range
|  |- MissingInput           a path that is not there, or a folder without what we need
|  |- BadMesh                a mesh file that cannot be read, or holds no surface
|  |- BadImage               a picture that cannot be read
|  |- BadCameras             a cameras file that cannot be read, or a view that is not in it
|  |- BadViews               a views folder that cannot be read
|  |- BadWeights             weights that are damaged, pickled, or of another model
|  `- OutputRefused          an output path that we cannot, or must not, write to
`- WorkFailed       exit 1   the input was fine and the work did not succeed
   |- OutOfSpace             the disk is full, or a size limit was met
   |- DamagedArtifact        an artifact whose bytes are not what its manifest says
   |- EmptySurface           a field that is nowhere inside the object, so that no mesh can be made of it
   `- MissingDependency      an optional package that this request needs
"""

from __future__ import annotations


class Mv3dError(Exception):
    """What went wrong in one line, and a hint that names the fix."""

    exit_code = 1

    def __init__(self, message: str, hint: str):
        super().__init__(" ".join(message.split()))
        self.hint = " ".join(hint.split())

    def __reduce__(self):  # worker processes send their errors home
        return type(self), (str(self), self.hint)


class InputError(Mv3dError):
    """What the user gave cannot be used."""

    exit_code = 2


class UsageError(InputError):
    """A command line that does not parse, or a setting out of range."""


class MissingInput(InputError):
    """A path that is not there, or a folder without what we need."""


class BadMesh(InputError):
    """A mesh file that cannot be read, or holds no surface."""


class BadImage(InputError):
    """A picture that cannot be read."""


class BadCameras(InputError):
    """A cameras file that cannot be read, or a view that is not in it."""


class BadViews(InputError):
    """A views folder that cannot be read."""


class BadWeights(InputError):
    """Weights that are damaged, pickled, or of another model."""


class OutputRefused(InputError):
    """An output path that we cannot, or must not, write to."""


class WorkFailed(Mv3dError):
    """The input was fine and the work did not succeed."""


class OutOfSpace(WorkFailed):
    """The disk is full, or a size limit was met."""


class DamagedArtifact(WorkFailed):
    """An artifact whose bytes are not what its manifest says."""


class EmptySurface(WorkFailed):
    """A field that is nowhere inside the object, so that no mesh can be made of it."""


class MissingDependency(WorkFailed):
    """An optional package that this request needs is not installed."""
