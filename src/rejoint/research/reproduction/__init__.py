"""The paper's experiments, run again: one module per experiment, one registry, one page.

Park, Lee, Kim and Ahn 2024, IEEE Access, https://doi.org/10.1109/ACCESS.2024.3359268. Their numbers stand beside
ours wherever they print one, and where their text leaves room, the page says which reading was run.
"""
