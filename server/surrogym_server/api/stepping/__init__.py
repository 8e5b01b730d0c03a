"""The fast path of steps: lean routes, the stream, and messages that are answered as they arrive.

Requests go to ``SessionEngine.advance``, or to ``SessionEngine.try_now`` if an answer must not wait.
"""
