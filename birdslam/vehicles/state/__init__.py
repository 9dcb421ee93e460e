"""What is learned of vehicles over time: size, motion, yaw and their road's tilt, each by a filter of its own."""
