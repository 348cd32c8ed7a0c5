"""Live simulation: camera frames in one by one, people and radar maps out, with bounded delay and memory."""

from tensorsim.live.labels import LiveLabel
from tensorsim.live.simulator import LiveFrame, LivePerson, LiveSimulator

__all__ = ["LiveFrame", "LiveLabel", "LivePerson", "LiveSimulator"]
