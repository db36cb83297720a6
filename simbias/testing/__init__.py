"""For tests of one's own components: conformance to the contracts, and shapes.

`conformance.checks(study)` yields what every component has to pass; `python -m simbias check hardware=mine`
does the same on the command line. `shapes.watch(study)` is the study, the shapes of its arrays checked.
"""
