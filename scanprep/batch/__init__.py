"""Work that is done once: tasks side by side, steps that are kept, one run at a time in a folder, nothing lost.

    workspace   an output: what scapekit wrote there, what is whole, what must be done anew; tasks and steps in it
    digests     what a result depends on: whole files, models, tables, settings
    values      results as files, without pickle
    pool        tasks in processes of this machine;  cluster  on the workers of Dask;  lock  one run at a time
"""
