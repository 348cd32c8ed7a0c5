"""``tensorsim models list | fetch | verify``: weights by name."""

from dataclasses import dataclass

import tyro

from tensorsim.commands.arguments import Several
from tensorsim.exceptions import TensorsimError


@dataclass(frozen=True)
class ListModels:
    """List the weights known by name: shipped ones, and those downloaded from their authors on demand."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim import registry

        for entry in registry.entries():
            there = "shipped" if entry.shipped else "fetched" if entry.path.is_file() else "online"
            words = [entry.network or "poses", there, entry.licence, entry.assurance]
            print(f"{entry.name}\n    {', '.join(words)}" + (f"; {entry.metrics}" if entry.metrics else ""))
            print(f"    {entry.source}; {entry.path if there != 'online' else entry.url}")


@dataclass(frozen=True)
class FetchModels:
    """Download weights into the cache, so that later runs need no internet connection."""

    names: tyro.conf.Positional[Several[str]]
    """Names as printed by `tensorsim models list`."""
    quiet: bool = False
    """No progress bar."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim import registry

        if not self.names:
            raise TensorsimError("models fetch: got no names, expected some of `tensorsim models list`")
        wanted = [registry.find(name) for name in self.names]
        for entry in wanted:
            print(f"{entry.name}: {registry.fetch(entry, self.quiet)} ({entry.assurance})")


@dataclass(frozen=True)
class VerifyModels:
    """Check shipped and fetched weights against their SHA-256 hashes."""

    def run(self) -> None:
        """Run the command."""
        from tensorsim import registry

        wrong = []
        for entry in registry.entries():
            if not entry.path.is_file() and not entry.shipped:
                continue
            try:
                digest = registry.verify(entry)
                print(f"ok    {entry.name}: {digest} ({entry.assurance})")
            except TensorsimError as error:
                wrong.append(entry.name)
                print(f"WRONG {error}")
        if wrong:
            raise TensorsimError(f"models verify: {', '.join(wrong)} failed verification")
