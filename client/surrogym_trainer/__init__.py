"""The trainer: policy searches, the promise and its audit, evaluations, policies, the report, the worker of jobs."""
