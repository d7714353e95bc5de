"""Logs and results on servers (s3://, gs://, https://, sftp://), fetched into a bounded cache.

urls.py names places and hides secrets; store.py is the one module that speaks to servers;
find.py finds logs and what lies beside them; cache.py keeps what was fetched; fetch.py fetches logs
and results; upload.py writes results; run.py is what commands use.
"""
