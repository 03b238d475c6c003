"""`python -m lidarlearn.data check ...`, see `lidarlearn.commands.check_data`."""

from lidarlearn.commands.check_data import main

main()
