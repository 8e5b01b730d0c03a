"""All that low latency needs on the way of a step: lean routes, the stream, and messages answered where they arrive.

Requests go to ``SessionEngine.advance``, or to ``SessionEngine.try_now`` where an answer must not wait.
"""
