"""What scanfind is held to, measured: recognition, speed, start-up, real scans. See README.md."""
