"""The project's wire protocol: conversion between bytes and Obs and Act, without threads,
sockets or Ray.
"""
