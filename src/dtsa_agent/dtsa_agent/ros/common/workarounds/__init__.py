"""What works around Fast DDS and rclpy: each file names the defect ("Upstream") and when it can go ("Delete when")."""
