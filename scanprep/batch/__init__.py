"""Work that is done once: tasks side by side, steps that are kept, one run at a time in an output, nothing lost.

    opening     an output for one run: locked, foreign files left alone, what a killed run left put right
    workspace   what is whole in an output, and what must be done anew: tasks and steps;  ownership  whose a file is
    room        where one task is worked on, in steps
    pool        tasks in processes of this machine;  cluster  on the workers of Dask
    digests     what a result depends on: whole files, models, tables, settings;  values  results as files, no pickle
"""
