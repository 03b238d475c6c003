"""Networks that regress the motion between two scans."""
