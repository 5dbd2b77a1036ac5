; What XLA calls: the stages of a handler of its foreign function interface, for all kernels of this process.
;
; When XLA makes a program with a call, `instantiate` finds the kernel by its name and counts the call among its holders;
; when XLA frees the program, `forget` counts it out. A kernel with holders is never freed.
; `execute` reads the pointers of the buffers from XLA's call frame, and shares the blocks of members among the threads of
; XLA's own pool. The calling thread works too, and waits only for parts that another thread has begun: it cannot hang,
; whether or not the pool ever starts a task. Whichever thread holds the control block last frees it.
; The constants @major, @minor and the places of XLA's functions in its table are defined by `_machine.py`.

%list = type { i64, ptr, i64, ptr, ptr }             ; its size, extensions, length, types, pointers
%attributes = type { i64, ptr, i64, ptr, ptr, ptr }  ; its size, extensions, length, types, names, pointers
%frame = type { i64, ptr, ptr, ptr, i32, %list, %list, %attributes, ptr }
                                                     ; its size, extensions, functions, context, stage, arguments, results
%buffer = type { i64, ptr, i32, ptr, i64, ptr }      ; its size, extensions, type, data, rank, shape
%scalar = type { i32, ptr }                          ; its type, value
%text = type { ptr, i64 }                            ; its characters, their number
%extension = type { i64, i32, ptr, ptr }             ; its size, type (1: metadata), next, metadata
%metadata = type { i64, { i64, ptr, i32, i32 }, i32, i64 }  ; its size, version, traits, type of the state
%functions = type { i64, ptr, { i64, ptr, i32, i32 }, ptr } ; its size, extensions, version, internal; then the table
%count.call = type { i64, ptr, ptr, ptr }            ; its size, extensions, context, result
%schedule.call = type { i64, ptr, ptr, ptr, ptr }    ; its size, extensions, context, task, data
%state.call = type { i64, ptr, ptr, i32, ptr, ptr }  ; its size, extensions, context, stage, type, state
%error.call = type { i64, ptr, ptr, i32 }            ; its size, extensions, message, code
%type.info = type { i64, ptr, ptr }                  ; its size, extensions, deleter

; The next one in the list; its name, its function `run`, and how many calls hold it, −1 if it has no code; the arrays
; that it reads and writes, and the members of a vector.
%kernel = type { ptr, ptr, ptr, i64, i64, i64, i64 }

; The next part, those done, the threads that hold the block, the parts; the function `run`, and its arguments but the
; first block.
%control = type { i64, i64, i64, i64, ptr, i64, i64, i64, i64 }

@kernels = internal global ptr null
@type = global i64 0  ; of the state, a kernel; XLA sets it
@type.information = global %type.info { i64 24, ptr null, ptr @forget }
@no.kernel = internal constant [50 x i8] c"the machine code of a loop is not in this process\00"

declare ptr @malloc(i64)
declare void @free(ptr)
declare ptr @strdup(ptr)
declare i32 @memcmp(ptr, ptr, i64)
declare i32 @sched_yield()
declare i64 @llvm.smin.i64(i64, i64)
declare i64 @llvm.smax.i64(i64, i64)

; A new kernel without code, in the list.
define ptr @create(ptr %name, i64 %inputs, i64 %outputs, i64 %lanes) {
  %end = getelementptr %kernel, ptr null, i64 1
  %size = ptrtoint ptr %end to i64
  %kernel = call ptr @malloc(i64 %size)
  %copy = call ptr @strdup(ptr %name)
  %head = load ptr, ptr @kernels
  store ptr %head, ptr %kernel
  %name.at = getelementptr %kernel, ptr %kernel, i64 0, i32 1
  store ptr %copy, ptr %name.at
  %holders.at = getelementptr %kernel, ptr %kernel, i64 0, i32 3
  store i64 -1, ptr %holders.at
  %inputs.at = getelementptr %kernel, ptr %kernel, i64 0, i32 4
  store i64 %inputs, ptr %inputs.at
  %outputs.at = getelementptr %kernel, ptr %kernel, i64 0, i32 5
  store i64 %outputs, ptr %outputs.at
  %lanes.at = getelementptr %kernel, ptr %kernel, i64 0, i32 6
  store i64 %lanes, ptr %lanes.at
  store atomic ptr %kernel, ptr @kernels release, align 8
  ret ptr %kernel
}

; From now on a kernel has code.
define void @open(ptr %kernel, ptr %run) {
  %run.at = getelementptr %kernel, ptr %kernel, i64 0, i32 2
  store ptr %run, ptr %run.at
  %holders.at = getelementptr %kernel, ptr %kernel, i64 0, i32 3
  store atomic i64 0, ptr %holders.at release, align 8
  ret void
}

; Whether a kernel has no holders; then from now on it has no code.
define i8 @close(ptr %kernel) {
  %holders.at = getelementptr %kernel, ptr %kernel, i64 0, i32 3
  %both = cmpxchg ptr %holders.at, i64 0, i64 -1 acq_rel acquire
  %done = extractvalue { i64, i1 } %both, 1
  %found = zext i1 %done to i8
  ret i8 %found
}

; One holder more; false if the kernel has no code.
define internal i1 @hold(ptr %kernel) {
entry:
  %holders.at = getelementptr %kernel, ptr %kernel, i64 0, i32 3
  br label %head
head:
  %holders = load atomic i64, ptr %holders.at acquire, align 8
  %closed = icmp slt i64 %holders, 0
  br i1 %closed, label %exit, label %try
try:
  %more = add i64 %holders, 1
  %both = cmpxchg ptr %holders.at, i64 %holders, i64 %more acq_rel acquire
  %done = extractvalue { i64, i1 } %both, 1
  br i1 %done, label %exit, label %head
exit:
  %found = phi i1 [ false, %head ], [ true, %try ]
  ret i1 %found
}

; One holder less.
define void @forget(ptr %kernel) {
  %holders.at = getelementptr %kernel, ptr %kernel, i64 0, i32 3
  %before = atomicrmw sub ptr %holders.at, i64 1 acq_rel
  ret void
}

; A function of XLA's table.
define internal ptr @function(ptr %frame, i64 %place) {
  %functions.at = getelementptr %frame, ptr %frame, i64 0, i32 2
  %functions = load ptr, ptr %functions.at
  %table = getelementptr %functions, ptr %functions, i64 1
  %function.at = getelementptr ptr, ptr %table, i64 %place
  %function = load ptr, ptr %function.at
  ret ptr %function
}

; XLA's function at this place, which sets or reads the state of a call; its error, or null.
define internal ptr @state(ptr %frame, i64 %place, ptr %call, ptr %state) {
  %context.at = getelementptr %frame, ptr %frame, i64 0, i32 3
  %context = load ptr, ptr %context.at
  store %state.call { i64 48, ptr null, ptr null, i32 0, ptr @type, ptr null }, ptr %call
  %to = getelementptr %state.call, ptr %call, i64 0, i32 2
  store ptr %context, ptr %to
  %state.at = getelementptr %state.call, ptr %call, i64 0, i32 5
  store ptr %state, ptr %state.at
  %function = call ptr @function(ptr %frame, i64 %place)
  %error = call ptr %function(ptr %call)
  ret ptr %error
}

; The data of a list of buffers, to consecutive pointers.
define internal void @copy(ptr %list, i64 %count, ptr %to) {
entry:
  %buffers.at = getelementptr %list, ptr %list, i64 0, i32 4
  %buffers = load ptr, ptr %buffers.at
  br label %head
head:
  %k = phi i64 [ 0, %entry ], [ %next, %body ]
  %more = icmp slt i64 %k, %count
  br i1 %more, label %body, label %exit
body:
  %buffer.at = getelementptr ptr, ptr %buffers, i64 %k
  %buffer = load ptr, ptr %buffer.at
  %data.at = getelementptr %buffer, ptr %buffer, i64 0, i32 3
  %data = load ptr, ptr %data.at
  %to.at = getelementptr ptr, ptr %to, i64 %k
  store ptr %data, ptr %to.at
  %next = add i64 %k, 1
  br label %head
exit:
  ret void
}

define internal ptr @attribute(ptr %frame, i64 %k) {
  %all.at = getelementptr %frame, ptr %frame, i64 0, i32 7, i32 5
  %all = load ptr, ptr %all.at
  %found.at = getelementptr ptr, ptr %all, i64 %k
  %found = load ptr, ptr %found.at
  ret ptr %found
}

define internal i64 @number.attribute(ptr %frame, i64 %k) {
  %scalar = call ptr @attribute(ptr %frame, i64 %k)
  %value.at = getelementptr %scalar, ptr %scalar, i64 0, i32 1
  %value = load ptr, ptr %value.at
  %found = load i64, ptr %value
  ret i64 %found
}

; A number of rows, or of steps of a row: x, or if x < 0 the 32 bits at pointer −1 − x, but not less than 0.
define internal i64 @number(i64 %x, ptr %pointers) {
entry:
  %given = icmp slt i64 %x, 0
  br i1 %given, label %read, label %exit
read:
  %place = sub i64 -1, %x
  %pointer.at = getelementptr ptr, ptr %pointers, i64 %place
  %pointer = load ptr, ptr %pointer.at
  %narrow = load i32, ptr %pointer
  %found = sext i32 %narrow to i64
  %natural = call i64 @llvm.smax.i64(i64 %found, i64 0)
  br label %exit
exit:
  %all = phi i64 [ %x, %entry ], [ %natural, %read ]
  ret i64 %all
}

; One part of the blocks after another, until none is left.
define internal void @work(ptr %control) {
entry:
  %done = getelementptr %control, ptr %control, i64 0, i32 1
  %parts.at = getelementptr %control, ptr %control, i64 0, i32 3
  %parts = load i64, ptr %parts.at
  %run.at = getelementptr %control, ptr %control, i64 0, i32 4
  %run = load ptr, ptr %run.at
  %blocks.at = getelementptr %control, ptr %control, i64 0, i32 5
  %blocks = load i64, ptr %blocks.at
  %members.at = getelementptr %control, ptr %control, i64 0, i32 6
  %members = load i64, ptr %members.at
  %rows.at = getelementptr %control, ptr %control, i64 0, i32 7
  %rows = load i64, ptr %rows.at
  %every.at = getelementptr %control, ptr %control, i64 0, i32 8
  %every = load i64, ptr %every.at
  %pointers = getelementptr %control, ptr %control, i64 1
  br label %head
head:
  %part = atomicrmw add ptr %control, i64 1 acq_rel
  %more = icmp slt i64 %part, %parts
  br i1 %more, label %body, label %exit
body:
  %first.of.parts = mul i64 %part, %blocks
  %first = sdiv i64 %first.of.parts, %parts
  %next = add i64 %part, 1
  %last.of.parts = mul i64 %next, %blocks
  %last = sdiv i64 %last.of.parts, %parts
  call void %run(i64 %first, i64 %last, i64 %members, i64 %rows, i64 %every, ptr %pointers)
  %before = atomicrmw add ptr %done, i64 1 acq_rel
  br label %head
exit:
  ret void
}

define internal void @release(ptr %control) {
entry:
  %holders = getelementptr %control, ptr %control, i64 0, i32 2
  %before = atomicrmw sub ptr %holders, i64 1 acq_rel
  %last = icmp eq i64 %before, 1
  br i1 %last, label %end, label %exit
end:
  call void @free(ptr %control)
  br label %exit
exit:
  ret void
}

define internal void @task(ptr %control) {
  call void @work(ptr %control)
  call void @release(ptr %control)
  ret void
}

; The number of threads of XLA's pool; 1 if there is none.
define internal i64 @pool(ptr %frame) {
entry:
  %count = alloca i64
  store i64 1, ptr %count
  %call = alloca %count.call
  store %count.call { i64 32, ptr null, ptr null, ptr null }, ptr %call
  %context.at = getelementptr %frame, ptr %frame, i64 0, i32 3
  %context = load ptr, ptr %context.at
  %to = getelementptr %count.call, ptr %call, i64 0, i32 2
  store ptr %context, ptr %to
  %count.at = getelementptr %count.call, ptr %call, i64 0, i32 3
  store ptr %count, ptr %count.at
  %place = load i64, ptr @count_threads
  %function = call ptr @function(ptr %frame, i64 %place)
  %error = call ptr %function(ptr %call)
  %known = icmp eq ptr %error, null
  %threads = load i64, ptr %count
  %found = select i1 %known, i64 %threads, i64 1
  ret i64 %found
}

; Whether XLA only asks what it calls; the type of the state is the answer.
define internal i1 @describe(ptr %frame, i64 %state) {
entry:
  %extension.at = getelementptr %frame, ptr %frame, i64 0, i32 1
  %extension = load ptr, ptr %extension.at
  %none = icmp eq ptr %extension, null
  br i1 %none, label %exit, label %extended
extended:
  %type.at = getelementptr %extension, ptr %extension, i64 0, i32 1
  %type = load i32, ptr %type.at
  %asks = icmp eq i32 %type, 1
  br i1 %asks, label %answer, label %exit
answer:
  %metadata.at = getelementptr %extension, ptr %extension, i64 0, i32 3
  %metadata = load ptr, ptr %metadata.at
  %major.at = getelementptr %metadata, ptr %metadata, i64 0, i32 1, i32 2
  %major = load i32, ptr @major
  store i32 %major, ptr %major.at
  %minor.at = getelementptr %metadata, ptr %metadata, i64 0, i32 1, i32 3
  %minor = load i32, ptr @minor
  store i32 %minor, ptr %minor.at
  %traits.at = getelementptr %metadata, ptr %metadata, i64 0, i32 2
  store i32 0, ptr %traits.at
  %state.at = getelementptr %metadata, ptr %metadata, i64 0, i32 3
  store i64 %state, ptr %state.at
  br label %exit
exit:
  %found = phi i1 [ false, %entry ], [ false, %extended ], [ true, %answer ]
  ret i1 %found
}

define ptr @instantiate(ptr %frame) {
entry:
  %type = load i64, ptr @type
  %asks = call i1 @describe(ptr %frame, i64 %type)
  br i1 %asks, label %done, label %search
search:
  %name = call ptr @attribute(ptr %frame, i64 1)
  %characters = load ptr, ptr %name
  %length.at = getelementptr %text, ptr %name, i64 0, i32 1
  %length = load i64, ptr %length.at
  %first = load atomic ptr, ptr @kernels acquire, align 8
  br label %head
head:
  %kernel = phi ptr [ %first, %search ], [ %next, %other ]
  %none = icmp eq ptr %kernel, null
  br i1 %none, label %missing, label %compare
compare:
  %own.at = getelementptr %kernel, ptr %kernel, i64 0, i32 1
  %own = load ptr, ptr %own.at
  %difference = call i32 @memcmp(ptr %own, ptr %characters, i64 %length)
  %same = icmp eq i32 %difference, 0
  br i1 %same, label %take, label %other
other:
  %next = load ptr, ptr %kernel
  br label %head
take:
  %held = call i1 @hold(ptr %kernel)
  br i1 %held, label %set, label %missing
set:
  %call = alloca %state.call
  %place = load i64, ptr @set_state
  %error = call ptr @state(ptr %frame, i64 %place, ptr %call, ptr %kernel)
  %right = icmp eq ptr %error, null
  br i1 %right, label %done, label %wrong
wrong:
  call void @forget(ptr %kernel)
  ret ptr %error
missing:
  %new = alloca %error.call
  store %error.call { i64 32, ptr null, ptr @no.kernel, i32 9 }, ptr %new
  %create.place = load i64, ptr @create_error
  %create = call ptr @function(ptr %frame, i64 %create.place)
  %unknown = call ptr %create(ptr %new)
  ret ptr %unknown
done:
  ret ptr null
}

define ptr @execute(ptr %frame) {
entry:
  %asks = call i1 @describe(ptr %frame, i64 0)
  br i1 %asks, label %described, label %find
described:
  ret ptr null
find:
  %state = alloca %state.call
  %state.place = load i64, ptr @get_state
  %no.state = call ptr @state(ptr %frame, i64 %state.place, ptr %state, ptr null)
  %known = icmp eq ptr %no.state, null
  br i1 %known, label %begin, label %failed
failed:
  ret ptr %no.state
begin:
  %kernel.at = getelementptr %state.call, ptr %state, i64 0, i32 5
  %kernel = load ptr, ptr %kernel.at
  %run.at = getelementptr %kernel, ptr %kernel, i64 0, i32 2
  %run = load ptr, ptr %run.at
  %inputs.at = getelementptr %kernel, ptr %kernel, i64 0, i32 4
  %inputs = load i64, ptr %inputs.at
  %outputs.at = getelementptr %kernel, ptr %kernel, i64 0, i32 5
  %outputs = load i64, ptr %outputs.at
  %lanes.at = getelementptr %kernel, ptr %kernel, i64 0, i32 6
  %lanes = load i64, ptr %lanes.at
  %every.or.place = call i64 @number.attribute(ptr %frame, i64 0)
  %members = call i64 @number.attribute(ptr %frame, i64 2)
  %stored.or.place = call i64 @number.attribute(ptr %frame, i64 3)
  %most.threads = call i64 @number.attribute(ptr %frame, i64 4)
  %fewer = sub i64 %lanes, 1
  %more.members = add i64 %members, %fewer
  %blocks = sdiv i64 %more.members, %lanes
  %arrays = add i64 %inputs, %outputs
  %end.of.control = getelementptr %control, ptr null, i64 1
  %end.of.pointers = getelementptr ptr, ptr %end.of.control, i64 %arrays
  %size = ptrtoint ptr %end.of.pointers to i64
  %control = call ptr @malloc(i64 %size)
  %pointers = getelementptr %control, ptr %control, i64 1
  %arguments = getelementptr %frame, ptr %frame, i64 0, i32 5
  call void @copy(ptr %arguments, i64 %inputs, ptr %pointers)
  %results = getelementptr %frame, ptr %frame, i64 0, i32 6
  %first.output = getelementptr ptr, ptr %pointers, i64 %inputs
  call void @copy(ptr %results, i64 %outputs, ptr %first.output)
  %steps = call i64 @number(i64 %every.or.place, ptr %pointers)
  %stored = call i64 @number(i64 %stored.or.place, ptr %pointers)
  %rows = mul i64 %stored, %steps
  %every = call i64 @llvm.smax.i64(i64 %steps, i64 1)
  %most = call i64 @llvm.smin.i64(i64 %blocks, i64 %most.threads)
  %several = icmp sgt i64 %most, 1
  br i1 %several, label %ask, label %alone
alone:
  call void %run(i64 0, i64 %blocks, i64 %members, i64 %rows, i64 %every, ptr %pointers)
  call void @free(ptr %control)
  ret ptr null
ask:
  %pool = call i64 @pool(ptr %frame)
  %threads = call i64 @llvm.smin.i64(i64 %pool, i64 %most)
  %helped = icmp sgt i64 %threads, 1
  br i1 %helped, label %share, label %alone
share:
  %helpers = sub i64 %threads, 1
  %wanted = mul i64 %threads, 4  ; parts per thread, so that all end at about the same time
  %parts = call i64 @llvm.smin.i64(i64 %wanted, i64 %blocks)
  store %control zeroinitializer, ptr %control
  %holders.at = getelementptr %control, ptr %control, i64 0, i32 2
  store i64 %threads, ptr %holders.at
  %parts.at = getelementptr %control, ptr %control, i64 0, i32 3
  store i64 %parts, ptr %parts.at
  %to.run = getelementptr %control, ptr %control, i64 0, i32 4
  store ptr %run, ptr %to.run
  %blocks.at = getelementptr %control, ptr %control, i64 0, i32 5
  store i64 %blocks, ptr %blocks.at
  %members.at = getelementptr %control, ptr %control, i64 0, i32 6
  store i64 %members, ptr %members.at
  %rows.at = getelementptr %control, ptr %control, i64 0, i32 7
  store i64 %rows, ptr %rows.at
  %every.at = getelementptr %control, ptr %control, i64 0, i32 8
  store i64 %every, ptr %every.at
  %call = alloca %schedule.call
  store %schedule.call { i64 40, ptr null, ptr null, ptr @task, ptr null }, ptr %call
  %context.at = getelementptr %frame, ptr %frame, i64 0, i32 3
  %context = load ptr, ptr %context.at
  %call.context = getelementptr %schedule.call, ptr %call, i64 0, i32 2
  store ptr %context, ptr %call.context
  %call.data = getelementptr %schedule.call, ptr %call, i64 0, i32 4
  store ptr %control, ptr %call.data
  %place = load i64, ptr @schedule
  %schedule = call ptr @function(ptr %frame, i64 %place)
  br label %head
head:
  %k = phi i64 [ 0, %share ], [ %next, %scheduled ]
  %left = icmp slt i64 %k, %helpers
  br i1 %left, label %one, label %own
one:
  %error = call ptr %schedule(ptr %call)
  %begun = icmp eq ptr %error, null
  br i1 %begun, label %scheduled, label %dropped
dropped:
  call void @release(ptr %control)
  br label %scheduled
scheduled:
  %next = add i64 %k, 1
  br label %head
own:
  call void @work(ptr %control)
  %done.at = getelementptr %control, ptr %control, i64 0, i32 1
  br label %wait
wait:
  %done = load atomic i64, ptr %done.at acquire, align 8
  %all = icmp sge i64 %done, %parts
  br i1 %all, label %end, label %yield
yield:
  %ignored = call i32 @sched_yield()
  br label %wait
end:
  call void @release(ptr %control)
  ret ptr null
}
