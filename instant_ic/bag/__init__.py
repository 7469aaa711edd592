"""Bags: write and read rosbag2 folders (MCAP) as bytes, replay them in lockstep, compare them (docs/bags.md)."""

from instant_ic.bag.files import BagReader, TopicSummary
from instant_ic.bag.message import BagError, BagMessage, DiskFullError, Schema
from instant_ic.bag.writer import BagWriter

__all__ = ["BagError", "BagMessage", "BagReader", "BagWriter", "DiskFullError", "Schema", "TopicSummary"]
