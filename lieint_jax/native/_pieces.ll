; The function `run` of a kernel whose members share numbers: it alternates between `first`, which writes those of some
; rows, and `steps`, which reads them for all blocks of members, so that they stay in the cache.
; The constants @arguments, @results, @carries (of the results), @capacity and @per.row are defined by `_pieces.py`.

declare ptr @malloc(i64)
declare void @free(ptr)
declare i64 @llvm.smin.i64(i64, i64)
declare i64 @llvm.smax.i64(i64, i64)
declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)
declare void @first(i64, i64, i64, i64, i64, i64, i64, ptr)
declare void @steps(i64, i64, i64, i64, i64, i64, i64, ptr)

define internal void @copy.pointers(ptr %to, ptr %from, i64 %count) {
  %bytes = mul i64 %count, 8
  call void @llvm.memcpy.p0.p0.i64(ptr %to, ptr %from, i64 %bytes, i1 false)
  ret void
}

define void @run(i64 %first, i64 %last, i64 %members, i64 %rows, i64 %every, ptr %pointers) {
entry:
  %arguments = load i64, ptr @arguments
  %results = load i64, ptr @results
  %carries = load i64, ptr @carries
  %arrays = add i64 %arguments, %results
  %more.arrays = add i64 %arrays, 2
  %of.steps = alloca ptr, i64 %more.arrays
  %of.first = alloca ptr, i64 %more.arrays
  %counts = alloca [2 x i64]  ; the capacity of the tape, and how many numbers there were to write
  %count.at = getelementptr i64, ptr %counts, i64 1
  call void @copy.pointers(ptr %of.steps, ptr %pointers, i64 %arrays)
  call void @copy.pointers(ptr %of.first, ptr %pointers, i64 %arguments)
  %results.at = getelementptr ptr, ptr %of.steps, i64 %arguments
  %steps.tape.at = getelementptr ptr, ptr %of.steps, i64 %arrays
  %steps.counts.at = getelementptr ptr, ptr %steps.tape.at, i64 1
  store ptr %counts, ptr %steps.counts.at
  %first.tape.at = getelementptr ptr, ptr %of.first, i64 %arguments
  %first.counts.at = getelementptr ptr, ptr %first.tape.at, i64 1
  store ptr %counts, ptr %first.counts.at
  %usual = load i64, ptr @capacity
  %of.row = load i64, ptr @per.row
  %quotient = sdiv i64 %usual, %of.row
  %usual.piece = call i64 @llvm.smax.i64(i64 %quotient, i64 1)
  br label %new
new:
  %at = phi i64 [ 0, %entry ], [ %begin, %longer ]
  %piece.of.new = phi i64 [ %usual.piece, %entry ], [ 1, %longer ]
  %room = phi i64 [ %usual, %entry ], [ %count, %longer ]
  %bytes = mul i64 %room, 8
  %tape = call ptr @malloc(i64 %bytes)
  store i64 %room, ptr %counts
  store ptr %tape, ptr %steps.tape.at
  store ptr %tape, ptr %first.tape.at
  br label %next
next:
  %begin = phi i64 [ %at, %new ], [ %begin, %shorter ], [ %end, %go ]
  %piece = phi i64 [ %piece.of.new, %new ], [ %half, %shorter ], [ %piece, %go ]
  %wanted = add i64 %begin, %piece
  %end = call i64 @llvm.smin.i64(i64 %wanted, i64 %rows)
  call void @first(i64 0, i64 1, i64 1, i64 %begin, i64 %end, i64 %rows, i64 %every, ptr %of.first)
  %count = load i64, ptr %count.at
  %fits = icmp sle i64 %count, %room
  br i1 %fits, label %go, label %large
large:
  %single = icmp eq i64 %piece, 1
  br i1 %single, label %longer, label %shorter
longer:
  call void @free(ptr %tape)
  br label %new
shorter:
  %half = sdiv i64 %piece, 2
  br label %next
go:
  call void @steps(i64 %first, i64 %last, i64 %members, i64 %begin, i64 %end, i64 %rows, i64 %every, ptr %of.steps)
  call void @copy.pointers(ptr %of.steps, ptr %results.at, i64 %carries)  ; the next piece begins where this one ends
  %left = icmp slt i64 %end, %rows
  br i1 %left, label %next, label %done
done:
  call void @free(ptr %tape)
  ret void
}
