"""The engine: it checks requests, puts them into the batch queue, runs batches, and builds
replies.

A field that several threads use has one writer or a lock. This list names the threads that write
each field, and what protects it. ARCHITECTURE.md describes the threads.

IncomingMessage.replies
    writers: each thread that answers a request
    protection: lock of the message; the first reply counts

PendingRequest.over
    writers: the thread that finishes or withdraws the request
    protection: is only ever set; the message ignores a second reply

PendingRequest.begun
    writers: policy: FairQueue.take, BatchQueue.give_back
    protection: lock of the queue

PendingRequest.reserved, .episode, .sought
    writers: the thread that reserves for the request
    protection: only one thread at a time reserves for, searches for or queues a request

Origin.sessions: episodes
    writers: policy
    protection: one writer; changes lock SessionTable, except those of inner operations

Origin.ended
    writers: the thread that ends the connection
    protection: is only ever set

Session: all fields but those below
    writers: policy; before the session is in the table, the thread that creates it
    protection: one writer; a reader gets the old or the new value

Session.over, .model at the end of the session
    writers: each thread that ends the session
    protection: lock of SessionTable

Session.announced
    writers: event loop
    protection: one writer

Session.times
    writers: each thread that answers an act
    protection: one answer at a time; RobotTimes has a lock

SessionTable: openings of waiting resets
    writers: each thread that reserves or undoes a reset, policy
    protection: lock of SessionTable

ServedModel: model, settings
    writers: policy; the thread that closes the engine, after the policy's thread has ended
    protection: one writer; a reader copies the reference

LoadedModel.closed
    writers: as ServedModel
    protection: LoadedModel.busy

Runner: next swap
    writers: the thread that swaps, policy
    protection: one swap at a time; the policy takes it between two batches

Session.weights, .follows
    writers: policy at a reset and a swap, the push that commits a version
    protection: lock of the ModelWeights of the session's model

ModelWeights: versions
    writers: pushes, policy
    protection: its lock; only the policy changes the version in the agent, with `busy`

Health: reasons
    writers: policy, event loop, the thread that starts or stops the engine
    protection: its lock; requests read one reference

PolicyCalls.under_way
    writers: each thread that calls the policy, for its own calls
    protection: single operations of a set; overdue copies it

PolicyCalls.failed_batches
    writers: policy
    protection: one writer

DrainList.draining
    writers: event loop
    protection: is only ever set

DrainList: connections
    writers: event loop, each thread that answers
    protection: its lock

Runner: unsent answers
    writers: policy
    protection: one writer, which passes the answers to policy-answers

Poller: lent to policy-reader
    writers: policy; periodic, while a batch runs
    protection: lock of the queue, under which the batch ends

BatchQueue, FairQueue, BatchWindow
    writers: each thread that queues, policy
    protection: lock of the queue

PolledConnection: pauses
    writers: the thread that polls it: policy or policy-reader, never both at once; websockets
    protection: Poller

PolledConnection: unsent bytes, unanswered messages, end
    writers: each thread that answers, or ends the connection
    protection: its lock

Account, Charge
    writers: the thread or the event loop that reads the connection; while another thread decodes
        a message, that thread
    protection: the connection reads no further message meanwhile

Sender: whether its client was requested to reconnect
    writers: each thread that answers
    protection: is only ever set

MetricsBuffer
    writers: each thread that answers, policy
    protection: its lock
"""
