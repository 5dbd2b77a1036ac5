"""The primitives of JAX in numbers: what each adds to the program that a walk through a jaxpr writes.

Control flow (`control_flow`), what acts on each entry or only moves entries (`elementwise`), sums and products
(`reductions`), and entries at indices that the program computes (`indexing`).
"""
