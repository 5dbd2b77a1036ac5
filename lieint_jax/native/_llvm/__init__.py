"""The text of LLVM IR, in layers: instructions (`text`), arrays (`memory`), numbers (`operations`), loops (`loops`)."""
