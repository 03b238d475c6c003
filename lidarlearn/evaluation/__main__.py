"""`python -m lidarlearn.evaluation compare|convergence ...`, see `lidarlearn.commands.evaluation`."""

from lidarlearn.commands.evaluation import main

main()
