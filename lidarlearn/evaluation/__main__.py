"""`python -m lidarlearn.evaluation compare|map|convergence ...`, see `lidarlearn.commands.evaluation`."""

from lidarlearn.commands.evaluation import main

main()
