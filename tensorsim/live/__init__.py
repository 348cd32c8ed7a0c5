"""Live: frames of a camera in one by one, people and radar maps out, with a bounded delay and bounded memory."""

from tensorsim.live.labels import LiveLabel
from tensorsim.live.simulator import LiveFrame, LivePerson, LiveSimulator

__all__ = ["LiveFrame", "LiveLabel", "LivePerson", "LiveSimulator"]
