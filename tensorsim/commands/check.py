"""``tensorsim check``: is this installation in order?"""

from dataclasses import dataclass

from tensorsim.exceptions import TensorsimError


@dataclass(frozen=True)
class Check:
    """Check the installation: libraries, shipped files, and a moving target through the radar chain."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim.selfcheck import run_checks

        if not run_checks():
            raise TensorsimError("the installation check failed, see above")
