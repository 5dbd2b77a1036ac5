"""The primitives of JAX in numbers: what each adds to the program that a walk through a jaxpr writes.

Control flow (`control_flow`), arithmetic of single numbers (`elementwise`), what only moves entries (`moves`), sums and
products (`reductions`), and entries at indices that the program computes (`indexing`).
"""
