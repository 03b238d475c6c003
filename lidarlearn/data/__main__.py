"""`python -m lidarlearn.data check|export ...`, see `lidarlearn.commands.data`."""

from lidarlearn.commands.data import main

main()
