"""The trainer: it searches for policies, predicts their real return, audits, evaluates, stores and deploys them, writes
reports, and runs the jobs that people request."""
