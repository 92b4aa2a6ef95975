"""What works around Fast DDS and rclpy; each says which defect, and when it can go."""
