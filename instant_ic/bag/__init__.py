"""Bags: rosbag2 folders (MCAP) written and read as bytes, replayed in lockstep, compared (docs/bags.md)."""

from instant_ic.bag.files import BagError, BagMessage, BagReader, BagWriter, TopicSummary

__all__ = ["BagError", "BagMessage", "BagReader", "BagWriter", "TopicSummary"]
