"""Bags in rosbag2's format (MCAP): writing, reading, replay in lockstep and comparison (docs/bags.md)."""

from instant_ic.bag.files import BagReader, TopicSummary
from instant_ic.bag.message import BagError, BagMessage, DiskFullError, Schema
from instant_ic.bag.writer import BagWriter

__all__ = ["BagError", "BagMessage", "BagReader", "BagWriter", "DiskFullError", "Schema", "TopicSummary"]
