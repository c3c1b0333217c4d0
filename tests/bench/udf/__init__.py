"""A baseline to compare with: garments as 3D unsigned distance fields, meshed cell by cell.

Run:  PYTHONPATH=tests python -m bench.udf.train --data DIR --category top --out DIR --minutes 30
"""
