"""Deployment: conversion of a policy to a controller that runs without Python, on a microcontroller, a PLC or in
another simulator."""
