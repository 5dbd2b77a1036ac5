"""The text of LLVM IR, in layers: instructions (`text`), values, arrays (`memory`), operations, loops."""
