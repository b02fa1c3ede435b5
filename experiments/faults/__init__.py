"""What becomes of damaged files, full disks, long runs and killed processes?"""
