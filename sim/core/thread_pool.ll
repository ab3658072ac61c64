; Threads that take the parallel loops of Taichi's kernels: see thread_pool.py.
;
; Taichi cuts a loop into tasks and calls @run, which returns when all of them are done. The caller takes tasks as every
; thread does: a thread that comes late, or never, costs nothing but its share.

@loops = internal global i32 0     ; begun and ended, each adds one: odd while tasks may be taken
@following = internal global i32 0 ; number of the task that is taken next
@busy = internal global i32 0      ; threads besides the caller that may hold a task
@asleep = internal global i32 0    ; threads in @sleep

; Of the loop that runs.
@tasks = internal global i32 0
@threads = internal global i32 0   ; most threads that may take part
@context = internal global ptr null
@task = internal global ptr null   ; void(context, thread, number of the task)

@mutex = internal global [128 x i8] zeroinitializer, align 16     ; room for a pthread_mutex_t
@condition = internal global [128 x i8] zeroinitializer, align 16 ; and a pthread_cond_t, of any system

declare i32 @sched_yield()
declare i32 @pthread_mutex_init(ptr, ptr)
declare i32 @pthread_mutex_lock(ptr)
declare i32 @pthread_mutex_unlock(ptr)
declare i32 @pthread_cond_init(ptr, ptr)
declare i32 @pthread_cond_wait(ptr, ptr)
declare i32 @pthread_cond_broadcast(ptr)

define void @prepare() {
  call i32 @pthread_mutex_init(ptr @mutex, ptr null)
  call i32 @pthread_cond_init(ptr @condition, ptr null)
  ret void
}

; Do the tasks of a loop; `parallel_for` of Taichi's runtime.
define void @run(ptr %pool, i32 %tasks, i32 %threads, ptr %context, ptr %task) {
  store i32 %tasks, ptr @tasks
  store i32 %threads, ptr @threads
  store ptr %context, ptr @context
  store ptr %task, ptr @task
  store atomic i32 0, ptr @following seq_cst, align 4
  atomicrmw add ptr @loops, i32 1 seq_cst
  %asleep = load atomic i32, ptr @asleep seq_cst, align 4
  %all_awake = icmp eq i32 %asleep, 0
  br i1 %all_awake, label %work, label %wake
wake:
  call i32 @pthread_mutex_lock(ptr @mutex)
  call i32 @pthread_cond_broadcast(ptr @condition)
  call i32 @pthread_mutex_unlock(ptr @mutex)
  br label %work
work:
  call void @take_tasks(i32 0)
  atomicrmw add ptr @loops, i32 1 seq_cst
  br label %wait
wait: ; for those that still hold a task
  %busy = load atomic i32, ptr @busy seq_cst, align 4
  %is_done = icmp eq i32 %busy, 0
  br i1 %is_done, label %done, label %yield
yield:
  call i32 @sched_yield()
  br label %wait
done:
  ret void
}

define internal void @take_tasks(i32 %thread) {
entry:
  %tasks = load i32, ptr @tasks
  %context = load ptr, ptr @context
  %task = load ptr, ptr @task
  br label %next
next:
  %number = atomicrmw add ptr @following, i32 1 seq_cst
  %is_left = icmp slt i32 %number, %tasks
  br i1 %is_left, label %do, label %done
do:
  call void %task(ptr %context, i32 %thread, i32 %number)
  br label %next
done:
  ret void
}

; What a thread does for good, after so many looks for a loop asleep.
define void @serve(i32 %thread, i32 %looks) {
entry:
  br label %begin
begin:
  %last = phi i32 [ 0, %entry ], [ %loop, %leave ], [ %last, %sleep ]
  br label %look
look:
  %looked = phi i32 [ 0, %begin ], [ %looked_again, %yield ]
  %loop = load atomic i32, ptr @loops seq_cst, align 4
  %is_new = call i1 @is_new(i32 %loop, i32 %last)
  br i1 %is_new, label %join, label %go_on
go_on:
  %looked_again = add i32 %looked, 1
  %is_tired = icmp eq i32 %looked_again, %looks
  br i1 %is_tired, label %sleep, label %yield
yield:
  call i32 @sched_yield()
  br label %look
sleep:
  call void @sleep(i32 %last)
  br label %begin
join: ; the loop may have ended since: then its caller does not wait, and nothing of it may be read
  atomicrmw add ptr @busy, i32 1 seq_cst
  %now = load atomic i32, ptr @loops seq_cst, align 4
  %still_runs = icmp eq i32 %now, %loop
  br i1 %still_runs, label %ask, label %leave
ask:
  %threads = load i32, ptr @threads
  %takes_part = icmp slt i32 %thread, %threads
  br i1 %takes_part, label %work, label %leave
work:
  call void @take_tasks(i32 %thread)
  br label %leave
leave:
  atomicrmw sub ptr @busy, i32 1 seq_cst
  br label %begin
}

define internal i1 @is_new(i32 %loop, i32 %last) {
  %is_running = trunc i32 %loop to i1
  %is_another = icmp ne i32 %loop, %last
  %is_new = and i1 %is_running, %is_another
  ret i1 %is_new
}

; Until there is a loop after the last one.
define internal void @sleep(i32 %last) {
  call i32 @pthread_mutex_lock(ptr @mutex)
  atomicrmw add ptr @asleep, i32 1 seq_cst
  br label %look
look:
  %loop = load atomic i32, ptr @loops seq_cst, align 4
  %is_new = call i1 @is_new(i32 %loop, i32 %last)
  br i1 %is_new, label %up, label %wait
wait:
  call i32 @pthread_cond_wait(ptr @condition, ptr @mutex)
  br label %look
up:
  atomicrmw sub ptr @asleep, i32 1 seq_cst
  call i32 @pthread_mutex_unlock(ptr @mutex)
  ret void
}
