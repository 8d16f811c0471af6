"""Repair a worn arm, emulated in this process, and open the report: `python examples/repair_an_arm.py`.

Takes some minutes; with `--quick` it does little of everything, to see that all of it works.
"""

import argparse

import rejoint

options = argparse.ArgumentParser(description=__doc__)
options.add_argument("--quick", action="store_true", help="do little of everything")
options.add_argument("--run", help="run folder; by default a new one below runs/")
chosen = options.parse_args()

result = rejoint.repair("emulated:worn", run=chosen.run, quick=chosen.quick)
print(result.diagnosis.verdict)
print("Use:", result.recommendation.controller)
print(*result.recommendation.why, sep="\n")
print("Report:", result.page)
