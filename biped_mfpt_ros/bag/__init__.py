"""Recorded runs: bags written so that nothing flushed is lost, and read without ROS running."""
