"""Jobs that take turns: the queue, its runner, notifications, the watch over the disk."""
