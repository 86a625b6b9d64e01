"""The three.js engine, in Chromium."""
