"""The paper's tables and figures: what is computed for them, and how it compares. No ROS in it."""
