"""Small programs as one function of the processor.

On a CPU, XLA runs a program as a list of kernels, and to call one takes longer than the arithmetic on
a handful of numbers. It can compile a program as one function instead, and does so of its own accord
for the tiniest of loops. Two attributes ask for the same where a program is known to be small
(`marked`, `small`). Loops that are small but for calls of a library are divided into few functions
(`divided`).
"""

from .call import in_one_function as in_one_function
