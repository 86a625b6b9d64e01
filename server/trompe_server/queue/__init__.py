"""The record of jobs in the database: submission, claims, events, retention."""
