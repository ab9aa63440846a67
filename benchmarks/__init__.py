"""How dvax compares: `python -m benchmarks [--full] [--only NAME ...] [--save]`.

Every ratio is taken in one run, the two sides in turn, after compilation; README.md says what each
case compares and how to read the table.
"""
